"""The environment interface, which is brax's, and a base class for environments with a MuJoCo model.

An environment is two pure functions of one (unbatched) episode, as in `brax.envs.base.Env`:

    reset(key) -> State                 s_0 ~ rho_0
    step(state, action) -> State        s_{t+1}, r_t, done;  action in [-1, 1]^m

`State` has the fields of brax's, so brax's wrappers and trainers accept these environments, without importing brax,
which is slow. Environments have no time limit: `done` means termination only.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from envs.physics import check_once, compile_model, compile_step
from envs.scenes import Scene

ASSETS = Path(__file__).parent / "assets"


class State(struct.PyTreeNode):
    """One environment after a reset or a step: the fields of `brax.envs.base.State`.

    Attributes:
      pipeline_state: only what the next step needs of the physics (not all of `mjx.Data`).
      obs: observation, `[observation_size]`.
      reward: r_t of the step that led here, scalar; 0 after a reset.
      done: 1.0 if that step ended in a terminal state, else 0.0.
      metrics: scalars to log, by name.
      info: empty here; brax's wrappers store their values in it.
    """

    pipeline_state: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array] = struct.field(default_factory=dict)
    info: dict[str, Any] = struct.field(default_factory=dict)


class AnyState(Protocol):
    """What is read of every state: of `State`, of brax's, and of a named tuple or dataclass of your own."""

    @property
    def obs(self) -> jax.Array: ...
    @property
    def reward(self) -> jax.Array: ...
    @property
    def done(self) -> jax.Array: ...
    @property
    def metrics(self) -> Mapping[str, jax.Array]: ...


class Env(Protocol):
    """What every environment has. An `interface` (below) and what `envs.scenes` reads are optional."""

    @property
    def observation_size(self) -> int: ...
    @property
    def action_size(self) -> int: ...
    def reset(self, rng: jax.Array, /) -> AnyState: ...
    def step(self, state: Any, action: jax.Array, /) -> AnyState: ...  # a state of its own


class Interface(NamedTuple):
    """The meaning of an environment's numbers for a robot; optional, as the attribute `interface`.

    Attributes:
      observations: name and unit of each observed number.
      commands: name and unit of each commanded number.
      limits: the commands at action 1; a command is limit * clip(action, -1, 1). None: the action itself is the
        command, without limits.
    """

    observations: tuple[str, ...]
    commands: tuple[str, ...]
    limits: tuple[float, ...] | None


def interface(env: Any) -> Interface:
    """The environment's interface in plain strings and floats; for environments without one, generic names.

    An environment may give its names and limits as any sequences, such as arrays of NumPy or JAX.
    """
    if hasattr(env, "interface"):
        observations, commands, limits = env.interface
        limits = None if limits is None else tuple(np.asarray(limits, float).ravel().tolist())
        return Interface(tuple(observations), tuple(commands), limits)
    names, commands = (
        tuple(f"{name}_{i}" for i in range(size))
        for name, size in (("observation", env.observation_size), ("action", env.action_size))
    )
    return Interface(names, commands, limits=None)


class MjxEnv:
    """Base class of environments with one MuJoCo model; a subclass adds `reset` and `step`.

    Args:
      spec: the MuJoCo specification, with the environment's options applied.
      num_substeps: physics steps between two actions.
      physics: how they are computed: "scalar" (C MuJoCo's step as scalar equations), "mjx" (MJX's step) or "mujoco" (C
        MuJoCo's step itself, which is never checked).
      check: log differences from C MuJoCo's motion (`envs.physics.check_model`), which takes a second or more. The
        shipped environments leave this to the tests.
      inputs, outputs: what `physics_step` is a function of, and what it returns (`envs.physics.compile_step`).
      collision: which geoms collide (`envs.physics.compile_step`).
    """

    if TYPE_CHECKING:  # a subclass has them

        def reset(self, rng: jax.Array, /) -> AnyState: ...
        def step(self, state: Any, action: jax.Array, /) -> AnyState: ...

    def __init__(
        self,
        spec: Any,
        num_substeps: int = 1,
        physics: str = "scalar",
        check: bool = True,
        *,
        inputs: tuple[str, ...] = ("qpos", "qvel", "ctrl"),
        outputs: tuple[str, ...] = ("qpos", "qvel"),
        collision: str | None = None,
    ):
        self.model = compile_model(spec)
        if check and physics != "mujoco":
            check_once(self.model)
        self.dt = self.model.opt.timestep * num_substeps
        self.physics_step = compile_step(
            self.model, num_substeps, inputs=inputs, outputs=outputs, physics=physics, collision=collision
        )

    @property
    def observation_size(self) -> int:
        return jax.eval_shape(self.reset, jax.random.key(0)).obs.shape[-1]

    @property
    def action_size(self) -> int:
        return self.model.nu

    @property
    def backend(self) -> str:
        return "mjx"

    @property
    def unwrapped(self) -> MjxEnv:
        return self

    @property
    def scene(self) -> Scene:
        """How a state looks; override it if the state has no `qpos` or the environment has a goal."""
        return Scene(self.model, lambda state: state.pipeline_state.qpos)


def with_fields(state: Any, **values: Any) -> Any:
    """The State with some fields replaced; it may be any named tuple or dataclass."""
    return state._replace(**values) if hasattr(state, "_replace") else dataclasses.replace(state, **values)


def initial_state(pipeline_state: Any, obs: jax.Array, metric_names: tuple[str, ...] = ()) -> State:
    """The State after a reset: reward, `done` and all metrics are 0."""
    zero = jnp.zeros((), getattr(obs, "dtype", float))  # if obs is not an array, envs.contract reports it
    return State(pipeline_state, obs, reward=zero, done=zero, metrics=dict.fromkeys(metric_names, zero))
