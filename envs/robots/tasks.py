"""What tasks with robots share: a step that carries the state, what joints show and cost, what an episode remembers."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING, Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.base import MjxEnv
from envs.robots.arms import Arm

if TYPE_CHECKING:
    import mujoco

logger = logging.getLogger(__name__)

TINY = 1e-12  # under a square root, whose gradient at 0 then is 0
SCALES = (0.05, 0.01)  # at which errors are observed besides [m]
PRECISION, PULL = 0.01, 0.1  # of the logarithm in `pull` [m or rad]


class RobotEnv(MjxEnv):
    """Base class of tasks whose states have the fields of the physics by their names.

    Args:
      spec: the specification of robot and task.
      robot: the compiled model of the robot.
      num_substeps: physics steps between two actions (`divide_step`).
      physics: how they are computed, as of `MjxEnv`.
      collision: which geoms collide, as of `MjxEnv`.
    """

    def __init__(self, spec: Any, robot: mujoco.MjModel, num_substeps: int, physics: str, collision: str | None = None):
        self.fields = ("qpos", "qvel", "qacc_warmstart", *(("act",) if robot.na else ()))
        inputs, outputs = (*self.fields, "ctrl"), (*self.fields, "qfrc_actuator")
        super().__init__(spec, num_substeps, physics, False, inputs=inputs, outputs=outputs, collision=collision)

    def advance(self, state: Any, ctrl: jax.Array) -> tuple[Any, jax.Array]:
        """(the state after the controls `[nu]`, the forces of the actuators on the joints `[nv]`)."""
        *moved, force = self.physics_step(*(getattr(state, name) for name in self.fields), ctrl)
        return state.replace(**dict(zip(self.fields, moved, strict=True))), force


def divide_step(spec: mujoco.MjSpec, dt: float, timestep: float | None = None) -> int:
    """Sets the time step to the part of `dt` [s] that is nearest to `timestep` or the model's; returns the parts."""
    number = max(1, round(dt / (timestep or spec.option.timestep)))
    spec.option.timestep = dt / number
    return number


def log_guesses(name: str, guesses: tuple[str, ...]) -> None:
    """Logs a line for each thing that a robot's model does not say."""
    for guess in guesses:
        logger.warning("%s: %s", name, guess)


def count_hold_steps(hold_time: float, dt: float) -> int:
    """Steps of `dt` for which a goal is held for `hold_time` [s], at least one."""
    return max(1, math.ceil(hold_time / dt - 1e-6))


# --- errors -----------------------------------------------------------------------------------------------------------


def find_length(vector: jax.Array) -> jax.Array:
    """|x| of a vector `[n]`, whose gradient at 0 is 0."""
    return jnp.sqrt(jnp.sum(vector**2) + TINY)


def pull(error: jax.Array) -> jax.Array:
    """f(x) = x + 0.1 log(1 + x / 0.01) of a distance [m] or an angle [rad]: slope 1 far from 0, and 11 at 0."""
    return error + PULL * jnp.log1p(error / PRECISION)


# --- joints of an arm -------------------------------------------------------------------------------------------------


class MovingArm(Protocol):
    """The parts of a task's state that its arm's joints are read from; see `envs.robots.controls` for `target`."""

    @property
    def qpos(self) -> jax.Array: ...
    @property
    def qvel(self) -> jax.Array: ...
    @property
    def target(self) -> jax.Array | None: ...


class JointWeights(Protocol):
    """The options of `find_penalty`."""

    @property
    def lambda_torque(self) -> float: ...
    @property
    def lambda_velocity(self) -> float: ...
    @property
    def lambda_rate(self) -> float: ...
    @property
    def lambda_limit(self) -> float: ...
    @property
    def limit_margin(self) -> float: ...


def observe_joints(arm: Arm, state: MovingArm) -> list[jax.Array]:
    """(cos q, sin q) of hinges, q of slides, q', and q* - q if there are set-points, in the order of `name_joints`."""
    angles = state.qpos[arm.qpos_of]
    turning = np.array([not joint.is_slide for joint in arm.joints])
    parts = [jnp.cos(angles[turning]), jnp.sin(angles[turning]), angles[~turning], state.qvel[arm.dof_of]]
    return parts + ([] if state.target is None else [state.target - angles])


def name_joints(arm: Arm, has_target: bool) -> list[str]:
    """Names and units of what `observe_joints` returns."""
    hinges, slides = ([joint.name for joint in arm.joints if joint.is_slide == kind] for kind in (False, True))
    names = [f"{function}({name})" for function in ("cos", "sin") for name in hinges]
    names += [f"{name} [m]" for name in slides]
    names += [f"{joint.name}' [{joint.unit}/s]" for joint in arm.joints]
    return names + ([f"{x.name} set-point - position [{x.unit}]" for x in arm.joints] if has_target else [])


def name_actions(commands: tuple[str, ...]) -> list[str]:
    """Names of the last action, by those of the commands."""
    return [f"last {name.partition(' [')[0]} / limit" for name in commands]


def find_penalty(
    weights: JointWeights, arm: Arm, state: MovingArm, torque: jax.Array, action: jax.Array, last: jax.Array
) -> jax.Array:
    """P = lambda_torque |tau|^2 + lambda_velocity |q'|^2 + lambda_rate |a - a_before|^2 + lambda_limit sum_i e_i^2.

    Args:
      weights: the options.
      arm: the arm.
      state: q and q' of the arm are part of it; e_i is how far joint i is within `limit_margin` of its range's ends.
      torque: tau of the arm's joints `[n]` [N m].
      action, last: a and the one before `[m]`.
    """
    near = arm.find_nearness(state.qpos[arm.qpos_of], weights.limit_margin)
    penalty = weights.lambda_torque * jnp.sum(torque**2)
    penalty += weights.lambda_velocity * jnp.sum(state.qvel[arm.dof_of] ** 2)
    penalty += weights.lambda_rate * jnp.sum((action - last) ** 2)
    return penalty + weights.lambda_limit * jnp.sum(near**2)


# --- what an episode remembers ----------------------------------------------------------------------------------------


@struct.dataclass
class Record:
    """What metrics remember of an episode with an arm.

    Attributes:
      steps: since the start.
      held: for how many steps the present goal has been held.
      actions: the last action and the one before `[2, m]`; 0 before the start.
      jerk: sum over the steps of the mean squared second difference of the actions.
      violation: how far a joint has been beyond its range at most [rad or m].
    """

    steps: jax.Array
    held: jax.Array
    actions: jax.Array
    jerk: jax.Array
    violation: jax.Array


def start_record(action_size: int) -> Record:
    """The record at the start."""
    zero = jnp.zeros(())
    return Record(zero, zero, jnp.zeros((2, action_size)), zero, zero)


def find_jerk(action: jax.Array, actions: jax.Array) -> jax.Array:
    """The mean squared second difference of an action `[m]` and the two before it `[2, m]`, the last one first."""
    last, before = actions
    return jnp.mean((action - 2 * last + before) ** 2)


def extend_record(record: Record, arm: Arm, angles: jax.Array, held: jax.Array, action: jax.Array) -> Record:
    """The record after a step, which `record.steps` counts already.

    Args:
      record: before the step, but for the number of steps.
      arm: the arm, at the positions `angles` `[n]`.
      held: for how many steps the goal has been held.
      action: of the step `[m]`.
    """
    excess = jnp.max(arm.find_nearness(angles, 0.0), initial=0.0)
    return Record(
        steps=record.steps,
        held=held,
        actions=jnp.stack([action, record.actions[0]]),
        jerk=record.jerk + find_jerk(action, record.actions),
        violation=jnp.maximum(record.violation, excess),
    )


def find_record_metrics(record: Record, dt: float) -> dict[str, jax.Array]:
    """How long the goal has been held [s], the mean jerk so far, and the largest violation [rad or m]."""
    return {
        "held": record.held * dt,
        "jerk": record.jerk / jnp.maximum(record.steps, 1.0),
        "limit_violation": record.violation,
    }
