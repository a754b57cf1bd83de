"""Steps and other functions of C MuJoCo, called from the compiled program: the reference, on all cores.

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

from envs.physics.fields import JACOBIANS, MODEL, Output, find_outputs, find_types
from envs.physics.models import MujocoModelError, model_name

if TYPE_CHECKING:
    import mujoco
    import mujoco.batch

MAX_BATCHES = 4  # number of batch sizes whose memory and threads are kept
# Fields whose new values the bounding boxes around the geoms of a body know nothing of, which are made when compiling.
BOXED = ("body_ipos", "body_iquat", "geom_pos", "geom_quat", "geom_size", "geom_margin")
FRAMES = ("body_ipos", "body_iquat", "geom_pos", "geom_quat", "site_pos", "site_quat")
SIMPLE = ("body_ipos", "body_iquat", "jnt_pos", "jnt_axis")  # a body's inertia matrix is diagonal only for some values
# Fields on which that diagonal depends, which MuJoCo takes from dof_M0 for such a body.
MASSES = ("body_mass", "body_inertia", "dof_armature")
ANY_RADIUS = 1e6  # m, of the spheres around geoms whose sizes differ, in which MuJoCo looks for contacts
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
    return _make_call(model, outputs, Simulations(model, num_substeps, inputs, outputs, masked))


def make_callback_fields(
    model: mujoco.MjModel,
    inputs: tuple[str, ...],
    outputs: tuple[str, ...],
    inverse: bool = False,
    masked: bool = False,
) -> Callable[..., tuple[jax.Array, ...]]:
    """The fields of a state by `mj_forward`, or by `mj_inverse`; otherwise as `make_callback_step`."""
    return _make_call(model, outputs, Simulations(model, 0, inputs, outputs, masked, inverse))


def _make_call(model: mujoco.MjModel, outputs: tuple[str, ...], simulations: Simulations) -> Callable:
    """The function of one environment whose batches the simulations compute."""

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

    Without substeps it is `mj_forward` of all environments, or with `inverse` `mj_inverse`. That, and what
    `mujoco.batch` has no function for (cfrc_ext), is computed for one environment after the other.

    Calls share no state. Calls from several threads run one after the other, each on all cores.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_substeps: int,
        inputs: Sequence[str],
        outputs: Sequence[str],
        masked: bool = False,
        inverse: bool = False,
    ):
        import mujoco

        self._model = _separate_frames(
            copy.copy(model), [name.removeprefix(MODEL) for name in inputs if name.startswith(MODEL)]
        )
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self._num_substeps, self._inputs, self._masked, self._inverse = num_substeps, inputs, masked, inverse
        self._outputs = find_outputs(model, outputs)
        self._data = mujoco.MjData(self._model)
        fields = {output.field for output in self._outputs}
        # With the flag, sensors of kinetic energy read that of the step before, here of another environment, and with
        # RK4 the energy is that of the last stage.
        energy, is_rk4 = mujoco.mjtEnableBit.mjENBL_ENERGY, model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4
        by_flag = not is_rk4 and mujoco.mjtSensor.mjSENS_E_KINETIC not in model.sensor_type
        self._model.opt.enableflags &= ~int(energy)
        if "energy" in fields and by_flag:
            self._model.opt.enableflags |= int(energy)
        self._alone = fields if inverse else fields & ({"cfrc_ext"} if by_flag else {"cfrc_ext", "energy"})
        self._scratch = copy.copy(self._model)
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
        given = dict(zip(self._inputs, rows, strict=not self._masked))
        for name, values in given.items():
            if name != "qacc":
                _get_field(batch, name)[...] = values
        is_sound = np.all([_is_sound(*field) for field in given.items()], 0)
        if self._masked:
            is_sound &= rows[-1][:, 0] != 0
        alone = self._compute(batch, is_sound, given)
        is_sound &= ~has_diverged(batch.warning[..., 1])
        for i, (output, array) in enumerate(zip(self._outputs, results, strict=True)):
            result = array.reshape(len(is_sound), -1)
            result[...] = alone[i] if i in alone else _read_output(batch, output)
            result[~is_sound] = np.nan if result.dtype.kind == "f" else 0

    def _compute(self, batch: mujoco.batch.Batch, is_sound: np.ndarray, given: dict) -> dict[int, np.ndarray]:
        """Steps or evaluates the environments; returns those outputs that the batch does not have, by their places."""
        if self._num_substeps and not self._alone:
            batch.step(is_sound, self._num_substeps)
            return {}
        if self._num_substeps > 1:
            batch.step(is_sound, self._num_substeps - 1)
        if not self._inverse:
            state = batch.state.copy()
            batch.forward(is_sound)
            batch.state[...] = state  # with the same start of the solver, for the same bits
        results = self._compute_alone(batch, is_sound, given) if self._alone else {}
        if self._num_substeps:
            batch.step(is_sound)
        return results

    def _compute_alone(self, batch: mujoco.batch.Batch, is_sound: np.ndarray, given: dict) -> dict[int, np.ndarray]:
        """The outputs that the batch does not have, by their places, computed for one environment after the other."""
        import mujoco

        model, has_own_models = self._model, any(name.startswith(MODEL) for name in self._inputs)
        places = [i for i, output in enumerate(self._outputs) if output.field in self._alone]
        results = {i: np.zeros((len(is_sound), _read(self._data, self._outputs[i]).size)) for i in places}
        for number in np.flatnonzero(is_sound).tolist():
            data = batch.get_data(number, self._data)
            model = batch.get_model(number, self._scratch) if has_own_models else model
            if self._inverse:
                data.qacc[:] = given["qacc"][number] if "qacc" in given else 0.0
                mujoco.mj_inverse(model, data)
            else:
                mujoco.mj_energyPos(model, data)
                mujoco.mj_energyVel(model, data)
                mujoco.mj_rnePostConstraint(model, data)
            for i in places:
                results[i][number] = _read(data, self._outputs[i]).ravel()
        return results

    def _make_batch(self, number: int) -> mujoco.batch.Batch:
        import mujoco.batch

        # a persistent batch keeps contacts and forces, from which cfrc_ext is computed
        threads, is_persistent = min(number, _count_cores()), bool(self._alone)
        batch = mujoco.batch.Batch(self._model, number, threads, persistent=is_persistent)
        for name in self._inputs:
            _get_field(batch, name)
        for output in self._outputs:  # only fields requested before a step are filled by it
            _read_output(batch, output)
        return batch


def _separate_frames(model: mujoco.MjModel, fields: Sequence[str]) -> mujoco.MjModel:
    """Disables MuJoCo's shortcuts for coinciding frames in the model, if the fields may separate the frames.

    So with the search for contacts by boxes and spheres around geoms, if the fields may move geoms out of them.

    Raises:
      ValueError: a field cannot differ between environments, or not without another one.
    """
    import mujoco.batch

    simple = np.flatnonzero((model.body_simple > 0) & (model.body_dofnum > 0))
    for name in fields:
        reason = ""
        if name in SIMPLE and simple.size:
            reason = f' if a body is compiled as simple: body {model.body(simple[0]).name!r} needs simple="false"'
        if reason or name not in mujoco.batch.MODEL_FIELDS:
            raise ValueError(f"model.{name}: with physics 'mujoco' it cannot differ between environments{reason}")
        if name in MASSES and simple.size and "dof_M0" not in fields:
            raise ValueError(
                f"model.{name}: C MuJoCo needs model.dof_M0 beside it, as body {model.body(simple[0]).name!r} is "
                "compiled as simple; derive_fields makes both"
            )
    if set(fields) & {*FRAMES, *SIMPLE}:
        for flags in (model.body_sameframe, model.geom_sameframe, model.site_sameframe):
            flags[:] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    if set(fields) & set(BOXED):
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    if "geom_size" in fields and "geom_rbound" not in fields:
        model.geom_rbound[model.geom_rbound > 0] = ANY_RADIUS
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


def _read_output(batch: mujoco.batch.Batch, output: Output) -> np.ndarray:
    """The values of an output in all simulations, `[N, size]`."""
    if output.field in JACOBIANS:
        return _find_jacobians(batch, output).reshape(batch.nsim, -1)
    values = batch.bind(output.field)
    return (values if output.place is None else values[:, output.place]).reshape(batch.nsim, -1)


def _read(data: mujoco.MjData, output: Output) -> np.ndarray:
    """The value of an output in one simulation."""
    values = getattr(data, output.field)
    return values if output.place is None else values[output.place]


def _find_jacobians(batch: mujoco.batch.Batch, output: Output) -> np.ndarray:
    """The Jacobians of sites or bodies, from the axes of all velocities, `[N, objects, 3, nv]`."""
    from envs.physics.dynamics.kinematics import find_carriers

    model, is_site = batch.model, output.field.startswith("site")
    axes, centers, points = (
        batch.bind("cdof"),
        batch.bind("subtree_com"),
        batch.bind("site_xpos" if is_site else "xpos"),
    )
    bodies = model.site_bodyid if is_site else np.arange(model.nbody)
    chosen = np.arange(len(bodies))[output.place if output.place is not None else slice(None)].reshape(-1)
    bodies = bodies[chosen]
    turning = axes[:, None, :, :3]
    if output.field.endswith("jacp"):
        arms = points[:, chosen] - centers[:, model.body_rootid[bodies]]
        turning = axes[:, None, :, 3:] + np.cross(turning, arms[:, :, None])
    return np.where(find_carriers(model)[bodies][:, :, None], turning, 0.0).swapaxes(2, 3)


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
