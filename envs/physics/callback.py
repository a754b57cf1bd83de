"""Steps of C MuJoCo, called from the compiled program: the reference, on all cores.

`mujoco.batch` steps all environments of a call in threads, with the same bits for any number of threads. On a CPU the
call reads and writes XLA's buffers directly. `jax.pure_callback` would copy large arguments in threads that may all be
waiting for the callback, as with two shards on two devices, and deadlock.
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

from envs.physics.fields import MODEL, find_types
from envs.physics.models import MujocoModelError, model_name

if TYPE_CHECKING:
    import mujoco
    import mujoco.batch

MAX_BATCHES = 4  # number of batch sizes whose memory and threads are kept
FRAMES = ("body_ipos", "body_iquat", "geom_pos", "geom_quat", "site_pos", "site_quat")
SIMPLE = ("body_ipos", "body_iquat", "jnt_pos", "jnt_axis")  # a body's inertia matrix is diagonal only for some values
# Initial counts of warnings: at the first one of a kind, counted from 0, MuJoCo prints it and writes it to a file.
INITIAL_COUNT = 1
# A divergence changes these counts: MuJoCo increments one, and sets the others to 0 when it then resets the simulation.
# Without the reset it would continue with NaN or huge numbers, and print warnings that are not counted.
DIVERGENCE_WARNINGS = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC", "mjWARN_BADCTRL")


def make_callback_step(
    model: mujoco.MjModel,
    num_substeps: int,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    masked: bool = False,
) -> Callable[..., tuple[jax.Array, ...]]:
    """`num_substeps` times `mj_step` in double precision, as a function like those of `compile_step`.

    All real numbers returned for an environment are NaN if one of its inputs is NaN, or if a position, velocity,
    acceleration or control is NaN or beyond 1e10 (`mjMAXVAL`) in one of the substeps. (MuJoCo itself would then reset
    the environment, or for a control set all controls to 0.) Other environments of the batch are not affected.

    Args:
      model, num_substeps, inputs, outputs: as in `compile_step`.
      masked: the function has one more argument, after the inputs, and steps only those environments where it is not 0;
        of the others it returns NaN.

    Raises:
      ValueError: an input is a field of the model that all environments of `mujoco.batch` share.
      MujocoModelError: `mujoco.batch` cannot step the model, for example because bodies may sleep.
    """
    simulations = Simulations(model, num_substeps, inputs, outputs, masked)

    def fill(_, results, *arrays):
        simulations.step(list(map(np.asarray, arrays)), list(map(np.asarray, results)))

    def step(*arrays):
        types = find_types(model, outputs)
        compute = functools.partial(simulations.compute, types)
        cpu_step = buffer_callback(fill, types, vmap_method="broadcast_all")
        default_step = functools.partial(jax.pure_callback, compute, types, vmap_method="broadcast_all")
        return tuple(jax.lax.platform_dependent(*arrays, cpu=cpu_step, default=default_step))

    return step


class Simulations:
    """Simulations of a model by `mujoco.batch`; one call of `step` is one control step of all environments.

    Calls share no state. Calls from several threads run one after the other, each on all cores.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_substeps: int,
        inputs: Sequence[str],
        outputs: Sequence[str],
        masked: bool = False,
    ):
        import mujoco

        self._model = _separate_frames(
            copy.copy(model), [name.removeprefix(MODEL) for name in inputs if name.startswith(MODEL)]
        )
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._num_substeps, self._inputs, self._outputs, self._masked = num_substeps, inputs, outputs, masked
        self._rank = len(find_types(model, inputs[:1])[0].shape)
        self._initial = _make_initial_state(self._model)
        self._batch = functools.lru_cache(maxsize=MAX_BATCHES)(self._make_batch)
        self._lock = threading.Lock()
        try:
            self._batch(1)
        except ValueError as error:
            raise MujocoModelError(f"{model_name(model)}: mujoco.batch cannot step it: {error}") from error

    def compute(self, types: Sequence[jax.ShapeDtypeStruct], *arrays: jax.Array) -> list[np.ndarray]:
        """The outputs of all environments from their inputs; leading axes are environments."""
        inputs = tuple(map(np.asarray, arrays))
        results = [np.empty((*self._leading_shape(inputs), *x.shape), x.dtype) for x in types]
        self.step(inputs, results)
        return results

    def step(self, arrays: Sequence[np.ndarray], results: Sequence[np.ndarray]) -> None:
        """Writes the outputs into `results`."""
        number = int(np.prod(self._leading_shape(arrays), dtype=int))
        if number:
            with self._lock, np.errstate(over="ignore"):  # numbers too large for float32 become inf
                self._step(self._batch(number), [x.reshape(number, -1) for x in arrays], results)

    def _leading_shape(self, arrays: Sequence[np.ndarray]) -> tuple[int, ...]:
        return arrays[0].shape[: arrays[0].ndim - self._rank]

    def _step(self, batch: mujoco.batch.Batch, rows: list[np.ndarray], results: Sequence[np.ndarray]) -> None:
        batch.state[...] = self._initial
        batch.warning[...] = INITIAL_COUNT
        for name, values in zip(self._inputs, rows, strict=not self._masked):
            _get_field(batch, name)[...] = values
        is_sound = np.all([_is_sound(*field) for field in zip(self._inputs, rows, strict=not self._masked)], 0)
        if self._masked:
            is_sound &= rows[-1][:, 0] != 0
        batch.step(is_sound, self._num_substeps)
        is_sound &= ~has_diverged(batch.warning[..., 1])
        for name, array in zip(self._outputs, results, strict=True):
            result = array.reshape(len(is_sound), -1)
            result[...] = _get_field(batch, name)
            result[~is_sound] = np.nan if result.dtype.kind == "f" else 0

    def _make_batch(self, number: int) -> mujoco.batch.Batch:
        import mujoco.batch

        batch = mujoco.batch.Batch(self._model, number, min(number, _count_cores()))
        for name in (*self._inputs, *self._outputs):  # only fields requested before a step are filled by it
            _get_field(batch, name)
        return batch


def _separate_frames(model: mujoco.MjModel, fields: Sequence[str]) -> mujoco.MjModel:
    """Disables MuJoCo's shortcuts for coinciding frames in the model, if the fields may separate the frames.

    Raises:
      ValueError: a field cannot differ between environments.
    """
    import mujoco.batch

    simple = np.flatnonzero((model.body_simple > 0) & (model.body_dofnum > 0))
    for name in fields:
        reason = ""
        if name in SIMPLE and simple.size:
            reason = f' if a body is compiled as simple: body {model.body(simple[0]).name!r} needs simple="false"'
        if reason or name not in mujoco.batch.MODEL_FIELDS:
            raise ValueError(f"model.{name}: with physics 'mujoco' it cannot differ between environments{reason}")
    if set(fields) & {*FRAMES, *SIMPLE}:
        for flags in (model.body_sameframe, model.geom_sameframe, model.site_sameframe):
            flags[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    return model


def _is_sound(name: str, values: np.ndarray) -> np.ndarray:
    """Whether MuJoCo can start from these values without a reset and without losing a NaN, `[N]` of bool."""
    import mujoco

    within = np.abs(values) <= mujoco.mjMAXVAL if name in ("qpos", "qvel") else ~np.isnan(values)
    return np.all(within, 1)


def has_diverged(counts: np.ndarray) -> np.ndarray | np.bool:
    """Whether a simulation diverged, by MuJoCo's counts of warnings `[..., kinds]`, initially `INITIAL_COUNT`."""
    import mujoco

    kinds = [int(getattr(mujoco.mjtWarning, name)) for name in DIVERGENCE_WARNINGS]
    return (counts[..., kinds] != INITIAL_COUNT).any(-1)


def _get_field(batch: mujoco.batch.Batch, name: str) -> np.ndarray:
    """A view of a field of all simulations, `[N, size]`; writing to it changes the next step."""
    is_model = name.startswith(MODEL)
    values = batch.expand(name.removeprefix(MODEL)) if is_model else batch.bind(name)
    return values.reshape(batch.nsim, -1)


def _make_initial_state(model: mujoco.MjModel) -> np.ndarray:
    """MuJoCo's integration state, which includes the inputs of a step, as in `mjx.make_data`."""
    import mujoco

    kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, mujoco.MjData(model), state, kind)
    return state


def _count_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
