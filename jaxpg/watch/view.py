"""Finds what can be drawn of an environment: its scene and its phase plane, checked on a state."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from envs.base import Env
from envs.scenes import PhasePlane, Scene, find_phase_plane, find_scene, find_time_step
from jaxpg.watch.attempts import DrawingError, attempt, describe_error


class View(NamedTuple):
    """What can be drawn of an environment; None for what it lacks or what cannot be drawn.

    Attributes:
      scene: its robot; without a goal if that cannot be drawn.
      plane: its phase plane.
    """

    scene: Scene | None
    plane: PhasePlane | None


def find_view(env: Env, say: Callable[[str], None] = lambda line: None) -> View:
    """What can be drawn of `env`; `say` takes a line for each thing that it has but that cannot be drawn."""
    state = jax.eval_shape(env.reset, jax.random.key(0))
    scene = attempt("picture of the robot", lambda: _find_scene(env, state), say)
    if scene and scene.goal and not attempt("goal", functools.partial(_has_goal, scene, state), say):
        scene = scene._replace(goal=None, goal_radius=None, goal_rotation=None)
    return View(scene, attempt("phase portrait", lambda: _find_plane(env, state), say))


def _find_scene(env: Env, state: Any) -> Scene | None:
    scene = _ask("scene", find_scene, env)
    if scene is None:
        return None
    import mujoco  # slow to import, and not needed without a scene

    if not isinstance(scene.model, mujoco.MjModel):
        raise DrawingError(f"scene.model is a {type(scene.model).__name__}, expected a mujoco.MjModel")
    _check_shape("scene.qpos(state)", scene.qpos, (state,), (scene.model.nq,))
    if scene.site is not None and not 0 <= scene.site < scene.model.nsite:
        raise DrawingError(f"scene.site is {scene.site}, the model has {scene.model.nsite} sites")
    dt = _ask("dt", find_time_step, env)
    if not 0 < dt < math.inf:
        raise DrawingError(f"dt is {dt}, expected seconds between two actions")
    return scene


def _has_goal(scene: Scene, state: Any) -> bool:
    assert scene.goal is not None  # whoever asks has looked
    _check_shape("scene.goal(state)", scene.goal, (state,), (3,))
    if scene.goal_radius is not None and not 0 < float(scene.goal_radius) < math.inf:
        raise DrawingError(f"scene.goal_radius is {scene.goal_radius}, expected metres or None")
    if scene.goal_rotation:
        _check_shape("scene.goal_rotation(state)", scene.goal_rotation, (state,), (3, 3))
    return True


def _find_plane(env: Env, state: Any) -> PhasePlane | None:
    plane = _ask("phase_plane", find_phase_plane, env)
    if plane is None:
        return None
    if not len(plane.labels) == len(plane.ranges) == len(plane.wraps) == 2:
        raise DrawingError("phase_plane must have two labels, two ranges and two values of wraps")
    if not all(-math.inf < low < high < math.inf for low, high in plane.ranges):
        raise DrawingError(f"phase_plane.ranges are {plane.ranges}, expected finite lower and upper ends")
    _check_shape("phase_plane.coordinates(state)", plane.coordinates, (state,), (2,))
    number = jax.ShapeDtypeStruct((), float)
    _check_shape("phase_plane.observe(x, y)", plane.observe, (number, number), state.obs.shape)
    return plane


def _ask(name: str, ask: Callable, *arguments: Any) -> Any:
    """The result of the environment's own code; an exception there becomes DrawingError."""
    try:
        return ask(*arguments)
    except Exception as error:
        raise DrawingError(f"{name} raises {describe_error(error)}") from error


def _check_shape(name: str, function: Callable, arguments: tuple, shape: tuple[int, ...]) -> None:
    result = _ask(name, lambda: jax.eval_shape(function, *arguments))
    if getattr(result, "shape", None) != tuple(shape):
        raise DrawingError(f"{name} has the shape {getattr(result, 'shape', None)}, expected {tuple(shape)}")
