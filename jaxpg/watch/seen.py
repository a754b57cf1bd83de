"""What of an environment can be seen: its scene and its phase plane, once they have been tried on a state."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from envs.scenes import PhasePlane, Scene, scene
from jaxpg.watch.attempts import NotDrawn, attempt, described


class Seen(NamedTuple):
    """None where the environment has no such thing, or not in a form that can be drawn.

    Attributes:
      scene: its robot; without a goal where that cannot be drawn.
      plane: its phase plane.
    """

    scene: Scene | None
    plane: PhasePlane | None


def seen(env: Any, say: Callable[[str], None] = lambda line: None) -> Seen:
    """What can be seen of `env`; `say` takes a line for each thing that it has, but that cannot be drawn."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    view = attempt("picture of the robot", lambda: _scene(env, state), say)
    if view and view.goal and not attempt("goal", lambda: _has_goal(view, state), say):
        view = view._replace(goal=None, goal_radius=None)
    return Seen(view, attempt("phase portrait", lambda: _plane(env, state), say))


def _scene(env: Any, state: Any) -> Scene | None:
    view = _asked("scene", scene, env)
    if view is None:
        return None
    import mujoco  # slow to import, and not needed for what has no scene

    if not isinstance(view.model, mujoco.MjModel):
        raise NotDrawn(f"scene.model is a {type(view.model).__name__}, expected a mujoco.MjModel")
    _check_shape("scene.qpos(state)", view.qpos, (state,), (view.model.nq,))
    dt = _asked("dt", lambda env: float(env.dt), env)
    if not 0 < dt < math.inf:
        raise NotDrawn(f"dt is {dt}, expected the seconds between two actions")
    return view


def _has_goal(view: Scene, state: Any) -> bool:
    _check_shape("scene.goal(state)", view.goal, (state,), (3,))
    radius = view.goal_radius
    if radius is not None and not 0 < float(radius) < math.inf:
        raise NotDrawn(f"scene.goal_radius is {radius}, expected metres or None")
    return True


def _plane(env: Any, state: Any) -> PhasePlane | None:
    plane = _asked("phase_plane", lambda env: getattr(env, "phase_plane", None), env)
    if plane is None:
        return None
    if not len(plane.labels) == len(plane.ranges) == len(plane.wraps) == 2:
        raise NotDrawn("phase_plane has not two labels, two ranges and twice whether they wrap")
    if not all(-math.inf < low < high < math.inf for low, high in plane.ranges):
        raise NotDrawn(f"phase_plane.ranges are {plane.ranges}, expected lower and upper ends")
    _check_shape("phase_plane.coordinates(state)", plane.coordinates, (state,), (2,))
    number = jax.ShapeDtypeStruct((), float)
    _check_shape("phase_plane.observe(x, y)", plane.observe, (number, number), state.obs.shape)
    return plane


def _asked(name: str, ask: Callable, *arguments: Any) -> Any:
    """What the environment's own code says; its exceptions are what cannot be drawn of it."""
    try:
        return ask(*arguments)
    except Exception as error:
        raise NotDrawn(f"{name} raises {described(error)}") from error


def _check_shape(name: str, function: Callable, arguments: tuple, shape: tuple[int, ...]) -> None:
    found = _asked(name, lambda: jax.eval_shape(function, *arguments))
    if getattr(found, "shape", None) != tuple(shape):
        raise NotDrawn(f"{name} has the shape {getattr(found, 'shape', None)}, expected {tuple(shape)}")
