"""Checks whether a model moves under `compile_step` as C MuJoCo moves it."""

from __future__ import annotations

import copy
import logging
import math
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from envs.physics.callback import INITIAL_COUNT, has_diverged
from envs.physics.collision import change_collision, describe_meshes
from envs.physics.models import (
    compile_model,
    find_control_ranges,
    ignored_features,
    load_spec,
    model_digest,
    model_name,
)
from envs.physics.numeric import evaluate
from envs.physics.step import compile_step, find_reason, make_scalar_program

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

SEGMENT = 20  # steps that are compared with C MuJoCo's before it begins anew from one of its states
NUM_KEYFRAMES = 3

_checked: set[bytes] = set()  # digests of the models that `check_once` has seen


def load_model(path: str | Path) -> mujoco.MjModel:
    """The compiled model in an MJCF file, checked by `check_once`.

    Raises:
      MujocoModelError: the file is missing or is not MJCF, or neither scalar equations nor C MuJoCo's batch take it.
    """
    model = compile_model(load_spec(path))
    check_once(model)
    return model


def check_once(model: mujoco.MjModel) -> None:
    """Logs the problems from `check_model` as warnings, once for each model in this process."""
    digest = model_digest(model)
    if digest not in _checked:
        _checked.add(digest)
        for line in check_model(model):
            logger.warning("%s: %s", model_name(model), line)


def check_model(
    model: mujoco.MjModel, num_steps: int = 200, tolerance: float = 1e-3, *, physics: str = "scalar"
) -> list[str]:
    """Problems of stepping a model as `compile_step` does, one line each; empty if there are none.

    Lists what is left out: the collision of meshes, or with `physics="mjx"` the features that MJX silently ignores.
    Then C MuJoCo, with enough iterations of its solver, moves the model for `num_steps` steps from each of the states
    of `_list_starts` under the controls of `_draw_controls`. From every `SEGMENT`-th state on the way, `compile_step`
    takes `SEGMENT` steps under the same controls: so it is compared all along the way, while rounding errors grow only
    for a short time. Positions, velocities, activations and sensors are compared. Nothing is to be compared for a model
    without scalar equations, which C MuJoCo itself steps.

    Args:
      model: a compiled model.
      num_steps: steps from each state.
      tolerance: allowed difference, relative to the largest position, velocity or activation, and for a sensor to its
        own largest value; each of them at least 1.
      physics: "scalar" or "mjx", as in `compile_step`.

    Raises:
      MujocoModelError: MJX cannot step the model, with `physics="mjx"`.
    """
    lines = [f"MJX leaves out: {feature}" for feature in ignored_features(model)] if physics == "mjx" else []
    if physics == "scalar":
        lines += [meshes] if (meshes := describe_meshes(model)) else []
        model = change_collision(model, "primitives")
    state = ("qpos", "qvel", "act", "qacc_warmstart") if model.na else ("qpos", "qvel", "qacc_warmstart")
    outputs = _choose_outputs(model, state, physics)
    starts = _list_starts(model)
    controls = _draw_controls(model, (len(starts), num_steps))
    true, diverged = _record(_converge(model) if outputs else model, outputs or state, starts, controls)
    if diverged:
        return [*lines, f"C MuJoCo's own motion diverges in step {diverged}: the timestep is too long for it"]
    if outputs:
        ours = _repeat(model, state, outputs, physics, true, controls)
        lines += _find_difference(model, outputs, true, ours, tolerance)
    return lines


def _choose_outputs(model: mujoco.MjModel, state: tuple[str, ...], physics: str) -> tuple[str, ...]:
    """What to compare: the state, with the sensors if there is a form of them too; nothing if C MuJoCo steps it."""
    all_outputs = (*state, "sensordata") if model.nsensordata else state
    if physics == "mjx":
        return all_outputs
    return next((x for x in (all_outputs, state) if not find_reason(model, (*state, "ctrl"), x)), ())


def _converge(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with a solver that ends at the solution: equations do not depend on its number of iterations."""
    import mujoco

    model = copy.copy(model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.iterations, model.opt.ls_iterations = max(model.opt.iterations, 100), max(model.opt.ls_iterations, 50)
    model.opt.tolerance = min(model.opt.tolerance, 1e-10)
    return model


def _list_starts(model: mujoco.MjModel) -> list[dict[str, np.ndarray]]:
    """The initial state, the same perturbed (0.1 rad or m, and per second) and up to three keyframes.

    The perturbed positions are within the joints' ranges: no equations are made for geoms that meet only beyond them.
    """
    import mujoco

    random, data = np.random.default_rng(0), mujoco.MjData(model)
    starts = [{name: getattr(data, name).copy() for name in ("qpos", "qvel", "act")} for _ in range(2)]
    speeds = 0.1 * random.normal(size=(2, model.nv))
    mujoco.mj_integratePos(model, starts[1]["qpos"], speeds[0], 1.0)
    is_scalar = model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)  # or a hinge
    limited = np.flatnonzero(model.jnt_limited.astype(bool) & is_scalar)
    places = model.jnt_qposadr[limited]
    starts[1]["qpos"][places] = starts[1]["qpos"][places].clip(*model.jnt_range[limited].T)
    starts[1]["qvel"] += speeds[1]
    keys = range(min(model.nkey, NUM_KEYFRAMES))
    return starts + [{n: getattr(model, f"key_{n}")[key].copy() for n in ("qpos", "qvel", "act")} for key in keys]


def _draw_controls(model: mujoco.MjModel, shape: tuple[int, ...]) -> np.ndarray:
    """Random controls of each actuator over its own range, or from -1 to 1; a fifth of them at one of the ends."""
    random = np.random.default_rng(1)
    low, high = find_control_ranges(model)
    share = random.uniform(-0.125, 1.125, (*shape, model.nu)).clip(0, 1)
    return low + (high - low) * share


def _record(model: mujoco.MjModel, names: tuple[str, ...], starts, controls: np.ndarray):
    """C MuJoCo's values before and after each step, `[S, T + 1, ...]` by name, and the step that diverged, or 0."""
    import mujoco

    shapes = {name: getattr(mujoco.MjData(model), name).shape for name in names}
    values = {name: np.zeros((len(starts), controls.shape[1] + 1, *shape)) for name, shape in shapes.items()}
    for number, start in enumerate(starts):
        data = mujoco.MjData(model)
        data.warning.number[:] = INITIAL_COUNT
        for name, x in start.items():
            setattr(data, name, x)
        for i in range(controls.shape[1] + 1):
            for name in names:
                values[name][number, i] = getattr(data, name)
            if i < controls.shape[1]:
                data.ctrl[:] = controls[number, i]
                mujoco.mj_step(model, data)
                if has_diverged(data.warning.number):
                    return values, i + 1
    return values, 0


def _repeat(model, state, outputs, physics: str, true: dict[str, np.ndarray], controls: np.ndarray):
    """Our values after each step, `[S, T, ...]` by name, beginning anew from C MuJoCo's every `SEGMENT` steps."""
    length = math.gcd(SEGMENT, controls.shape[1])
    begin = [_flatten(true[name][:, :-1:length]) for name in state]
    segments = controls.reshape(len(begin[0]), length, model.nu)
    shape = controls.shape[:2]
    if physics == "mjx":
        results = _play_mjx(model, state, outputs, begin, segments)
        return {name: np.asarray(x).reshape(*shape, -1) for name, x in zip(outputs, results, strict=True)}
    results, left = _play_equations(model, state, outputs, begin, segments)
    left = left.reshape(*shape, 1)
    return {
        name: np.where(left, true[name][:, 1:].reshape(*shape, -1), x.reshape(*shape, -1))
        for name, x in zip(outputs, results, strict=True)
    }


def _play_equations(model, state, outputs, begin: list[np.ndarray], segments: np.ndarray):
    """The outputs after each step of each segment, `[N, T, ...]`, of the scalar equations, in jax's default precision.

    And whether the step, or one before it in the segment, is left to C MuJoCo, `[N, T]`.
    """
    program = make_scalar_program(model, (*state, "ctrl"), outputs)
    is_watching = len(program.inputs) > len(state) + 1
    flag, values, steps, flags = np.zeros(len(segments)), begin, [], []
    for ctrl in np.moveaxis(segments, 1, 0):
        results = evaluate(program, [*values, ctrl, *([flag] if is_watching else [])])
        if is_watching:
            *results, flag = results
        values = results[: len(state)]
        steps.append(results)
        flags.append(flag > 0)
    return [np.stack(column, axis=1) for column in zip(*steps, strict=True)], np.stack(flags, axis=1)


def _play_mjx(model, state, outputs, begin: list[np.ndarray], segments: np.ndarray) -> list[jax.Array]:
    """The same by `mjx.step`, in jax's default precision."""
    step = compile_step(model, inputs=(*state, "ctrl"), outputs=outputs, physics="mjx")

    def play(values, segment):
        def turn(values, ctrl):
            results = step(*values, ctrl)
            return results[: len(state)], results

        return jax.lax.scan(turn, values, segment)[1]

    return jax.jit(jax.vmap(play))(tuple(map(jnp.asarray, begin)), jnp.asarray(segments))


def _flatten(values: np.ndarray) -> np.ndarray:
    return values.reshape(-1, *values.shape[2:])


def _find_difference(model, names, true, ours, tolerance: float) -> list[str]:
    """A line about the first step whose values differ by more than the tolerance, if there is one."""
    parts = {name: (name, slice(None)) for name in names if name not in ("qacc_warmstart", "sensordata")}
    if "sensordata" in names:
        for i, (begin, size) in enumerate(zip(model.sensor_adr.tolist(), model.sensor_dim.tolist(), strict=True)):
            parts[_describe_sensor(model, i)] = ("sensordata", slice(begin, begin + size))
    found = []
    for label, (name, part) in parts.items():
        reference, mine = true[name][:, 1:, part], ours[name][..., part]
        scale = max(1.0, np.max(np.abs(reference), initial=0.0))
        errors = np.max(np.abs(mine - reference), axis=(0, 2), initial=0.0) / scale
        step = int(np.argmax(~(errors <= tolerance)))
        if not errors[step] <= tolerance:
            found.append((step + 1, f"{label} differs from C MuJoCo's by {errors[step]:.1g} of its size"))
    return [f"{line} after {step} steps" for step, line in sorted(found)[:1]]


def _describe_sensor(model: mujoco.MjModel, sensor: int) -> str:
    import mujoco

    kind = mujoco.mjtSensor(int(model.sensor_type[sensor])).name.removeprefix("mjSENS_").lower()
    name = model.sensor(sensor).name
    label = f"'{name}'" if name else f"number {sensor}"
    return f"the {kind} sensor {label}"
