"""C MuJoCo's own step, called back from the compiled program: the reference, environment after environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import numpy as np

if TYPE_CHECKING:
    import mujoco


def callback_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> Callable[..., tuple[jax.Array, ...]]:
    """`num_substeps` times `mj_step`, in double precision, as a function like those of `compile_step`.

    Args:
      model, num_substeps, inputs, outputs: as there; the model is the same in all environments.

    Raises:
      ValueError: the model is among the inputs.
    """
    import mujoco

    fields = [name for name in inputs if name.startswith("model.")]
    if fields:
        raise ValueError(f"{fields[0]}: with physics 'mujoco' all environments have the model as it is")
    data = mujoco.MjData(model)
    shapes = [jax.ShapeDtypeStruct(np.shape(getattr(data, name)), np.float32) for name in outputs]

    def rows(*arrays: jax.Array) -> list[np.ndarray]:
        """Of all environments: leading axes are theirs."""
        arrays = [np.asarray(array, np.float64) for array in arrays]
        leading = np.shape(arrays[0])[: arrays[0].ndim - np.ndim(getattr(data, inputs[0]))]
        results = [np.empty((*leading, *shape.shape), np.float32) for shape in shapes]
        for place in np.ndindex(*leading):
            mujoco.mj_resetData(model, data)
            for name, array in zip(inputs, arrays, strict=True):
                getattr(data, name)[...] = array[place]
            for _ in range(num_substeps):
                mujoco.mj_step(model, data)
            for name, result in zip(outputs, results, strict=True):
                result[place] = getattr(data, name)
        return results

    def step(*arrays):
        return tuple(jax.pure_callback(rows, shapes, *arrays, vmap_method="broadcast_all"))

    return step
