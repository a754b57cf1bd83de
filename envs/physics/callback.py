"""C MuJoCo's own step, called from the compiled program: the reference, on all cores.

`mujoco.batch` steps all environments of a call in its threads, with the same bits at any number of them. On a CPU the
call reads and writes XLA's own buffers: `jax.pure_callback` copies large arguments by threads that may all be waiting
for the callback already, as with one device for each of two shards, and then no step ever ends.
"""

from __future__ import annotations

import copy
import functools
import os
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np
from jax.experimental.buffer_callback import buffer_callback

from envs.physics.fields import MODEL, types_of
from envs.physics.models import MujocoModelError, model_name

if TYPE_CHECKING:
    import mujoco
    import mujoco.batch

KEPT = 4  # sizes of batches that keep their memory and threads
FRAMES = ("body_ipos", "body_iquat", "geom_pos", "geom_quat", "site_pos", "site_quat")
SIMPLE = ("body_ipos", "body_iquat", "jnt_pos", "jnt_axis")  # on which a diagonal inertia matrix of a body depends
# MuJoCo prints a warning, and writes it into a file in the working directory, when it counts the first of its kind.
COUNTED = 1
# What becomes of these counts shows a divergence: MuJoCo counts it, and sets the others to 0 when it then restarts the
# simulation. Without the restart it would go on with what is NaN or huge, and print more that nothing counts.
DIVERGED = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")


def callback_step(
    model: mujoco.MjModel, num_substeps: int, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> Callable[..., tuple[jax.Array, ...]]:
    """`num_substeps` times `mj_step`, in double precision, as a function like those of `compile_step`.

    All real numbers that it returns of an environment are NaN if one of its inputs is, or if in one of the substeps a
    position, velocity or acceleration is NaN or beyond 1e10 (`mjMAXVAL`), where MuJoCo by itself would restart the
    environment, or a control is so, where MuJoCo sets all controls to 0. Other environments of the batch go on.

    Args:
      model, num_substeps, inputs, outputs: as there.

    Raises:
      ValueError: among the inputs is a field of the model that `mujoco.batch` has once for all environments.
      MujocoModelError: `mujoco.batch` cannot step the model, as where bodies may fall asleep.
    """
    simulations = Simulations(model, num_substeps, inputs, outputs)

    def fill(_, results, *arrays):
        simulations.step(list(map(np.asarray, arrays)), list(map(np.asarray, results)))

    def step(*arrays):
        types = types_of(model, outputs)
        make = functools.partial(simulations.results, types)
        here = buffer_callback(fill, types, vmap_method="broadcast_all")
        elsewhere = functools.partial(jax.pure_callback, make, types, vmap_method="broadcast_all")
        return tuple(jax.lax.platform_dependent(*arrays, cpu=here, default=elsewhere))

    return step


class Simulations:
    """Simulations of a model by `mujoco.batch`; one call of `step` is one control step of all that it is given.

    Nothing is left of a call for the next one. Calls from several threads wait for one another: each has all cores.
    """

    def __init__(self, model: mujoco.MjModel, num_substeps: int, inputs: Sequence[str], outputs: Sequence[str]):
        import mujoco

        self._model = _with_frames(
            copy.copy(model), [name.removeprefix(MODEL) for name in inputs if name.startswith(MODEL)]
        )
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._num_substeps, self._inputs, self._outputs = num_substeps, inputs, outputs
        self._rank = len(types_of(model, inputs[:1])[0].shape)
        self._initial = _initial_state(self._model)
        self._batch = functools.lru_cache(maxsize=KEPT)(self._new_batch)
        self._lock = threading.Lock()
        try:
            self._batch(1)
        except ValueError as error:
            raise MujocoModelError(f"{model_name(model)}: mujoco.batch cannot step it: {error}") from error

    def results(self, types: Sequence[jax.ShapeDtypeStruct], *arrays: jax.Array) -> list[np.ndarray]:
        """The outputs of all environments, from the inputs of all: leading axes are theirs."""
        given = tuple(map(np.asarray, arrays))
        found = [np.empty((*self._leading(given), *x.shape), x.dtype) for x in types]
        self.step(given, found)
        return found

    def step(self, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
        """Fills the results as `results` makes them."""
        number = int(np.prod(self._leading(arrays), dtype=int))
        if number:
            with self._lock, np.errstate(over="ignore"):  # what is too large for float32 becomes inf
                self._step(self._batch(number), [x.reshape(number, -1) for x in arrays], results)

    def _leading(self, arrays: Sequence[np.ndarray]) -> tuple[int, ...]:
        return arrays[0].shape[: arrays[0].ndim - self._rank]

    def _step(self, batch: mujoco.batch.Batch, rows: list[np.ndarray], results: Sequence[np.ndarray]) -> None:
        batch.state[...] = self._initial
        batch.warning[...] = COUNTED
        for name, values in zip(self._inputs, rows, strict=True):
            _field(batch, name)[...] = values
        sound = np.all([_sound(name, values) for name, values in zip(self._inputs, rows, strict=True)], 0)
        batch.step(sound, self._num_substeps)
        sound &= ~has_diverged(batch.warning[..., 1])
        for name, array in zip(self._outputs, results, strict=True):
            result = array.reshape(len(sound), -1)
            result[...] = _field(batch, name)
            result[~sound] = np.nan if result.dtype.kind == "f" else 0

    def _new_batch(self, number: int) -> mujoco.batch.Batch:
        import mujoco.batch

        batch = mujoco.batch.Batch(self._model, number, min(number, _num_cores()))
        for name in (*self._inputs, *self._outputs):  # what is asked for before a step is filled by it
            _field(batch, name)
        return batch


def _with_frames(model: mujoco.MjModel, fields: Sequence[str]) -> mujoco.MjModel:
    """The model without MuJoCo's shortcuts for frames that coincide when it is compiled, where the fields part them.

    Raises:
      ValueError: environments cannot differ in one of the fields.
    """
    import mujoco.batch

    simple = np.flatnonzero((model.body_simple > 0) & (model.body_dofnum > 0))
    for name in fields:
        reason = ""
        if name in SIMPLE and simple.size:
            reason = f' where a body is compiled as simple: body {model.body(simple[0]).name!r} needs simple="false"'
        if reason or name not in mujoco.batch.MODEL_FIELDS:
            raise ValueError(f"model.{name}: with physics 'mujoco' it cannot differ between environments{reason}")
    if set(fields) & {*FRAMES, *SIMPLE}:
        for flags in (model.body_sameframe, model.geom_sameframe, model.site_sameframe):
            flags[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    return model


def _sound(name: str, values: np.ndarray) -> np.ndarray:
    """Where MuJoCo would not restart a simulation at once, nor a NaN get lost, `[N]`."""
    import mujoco

    within = np.abs(values) <= mujoco.mjMAXVAL if name in ("qpos", "qvel") else ~np.isnan(values)
    return np.all(within, 1)


def has_diverged(counts: np.ndarray) -> np.ndarray | np.bool:
    """Whether MuJoCo says so, by its counts of warnings `[..., kinds]`, all of which began with `COUNTED`."""
    import mujoco

    kinds = [int(getattr(mujoco.mjtWarning, name)) for name in DIVERGED]
    return (counts[..., kinds] != COUNTED).any(-1)


def _field(batch: mujoco.batch.Batch, name: str) -> np.ndarray:
    """The numbers of a field of all simulations, `[N, size]`; what is written into them is what the next step gets."""
    is_model = name.startswith(MODEL)
    values = batch.expand(name.removeprefix(MODEL)) if is_model else batch.bind(name)
    return values.reshape(batch.nsim, -1)


def _initial_state(model: mujoco.MjModel) -> np.ndarray:
    """What MuJoCo integrates, with the inputs of a step among it, as `mjx.make_data` has it."""
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, mujoco.MjData(model), state, kind)
    return state


def _num_cores() -> int:
    """Those that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
