"""How the states of an environment look: for videos and reports, not for training.

All three attributes are optional. `scene` shows the robot; brax's own environments have a MuJoCo model instead. An
environment whose state is a point in a plane may have a `phase_plane`, over which the value function is drawn as a map.
`references` are returns to compare with, by label, such as `{"best possible": -137.4}`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax


class Scene(NamedTuple):
    """A MuJoCo model, and its pose in a state.

    Attributes:
      model: `mujoco.MjModel`.
      qpos: `qpos(State) -> [nq]`, the joint positions.
      goal: `goal(State) -> [3]`, the place that the robot should reach [m]; None if there is none.
      goal_radius: distance that counts as reached [m]; None without a goal.
      goal_rotation: `goal_rotation(State) -> [3, 3]`, the orientation that the robot should reach, as the axes of its
        frame in columns; None if any will do.
      site: index of the site whose place, and orientation, should become the goal's; None if the robot has none.
    """

    model: Any
    qpos: Callable[[Any], jax.Array]
    goal: Callable[[Any], jax.Array] | None = None
    goal_radius: float | None = None
    goal_rotation: Callable[[Any], jax.Array] | None = None
    site: int | None = None


class PhasePlane(NamedTuple):
    """Two coordinates x, y that determine a state.

    Attributes:
      labels: their names and units.
      ranges: lower and upper end of each.
      wraps: for each, whether both ends of the range are the same state.
      coordinates: `coordinates(State) -> [2]`; a coordinate that wraps may be out of its range.
      observe: `observe(x, y) -> obs`.
    """

    labels: tuple[str, str]
    ranges: tuple[tuple[float, float], tuple[float, float]]
    wraps: tuple[bool, bool]
    coordinates: Callable[[Any], jax.Array]
    observe: Callable[[jax.Array, jax.Array], jax.Array]


def find_scene(env: Any) -> Scene | None:
    """How the states of `env` look; None if it cannot be drawn, like the quadratic problem."""
    if hasattr(env, "scene"):
        return env.scene
    model = getattr(getattr(env, "sys", None), "mj_model", None)  # brax's
    return Scene(model, lambda state: state.pipeline_state.q) if model is not None else None


def find_time_step(env: Any) -> float:
    """Seconds between two actions, the environment's `dt`; what can be drawn has it."""
    return float(env.dt)


def find_phase_plane(env: Any) -> PhasePlane | None:
    """The environment's `phase_plane`, if it has one."""
    return getattr(env, "phase_plane", None)


def find_references(env: Any) -> Mapping[str, float]:
    """Returns to compare with, by label; empty if the environment has none."""
    return getattr(env, "references", {})
