"""The environments for Gymnasium: a single one, or N in one compiled step.

    gymnasium.make("jaxpg/Pendulum-v0", mass=2.0)
    gymnasium.make_vec("jaxpg/Pendulum-v0", num_envs=64)

Importing `jaxpg.gymnasium` registers the names. As in Gymnasium's own Pendulum-v1, an action is the command itself, in
physical units, and Gymnasium applies the time limit (`max_episode_steps`).

`reset(seed=s)` starts as the environment itself does with the key of s. Later episodes draw their seeds from
`np_random`, the generator that Gymnasium creates from s; so a batch plays the same as N single environments with the
seeds s, s + 1, ... If the physics diverges, the episode is terminated with the observation before it and reward 0.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

import envs
from envs.base import Env, interface, with_fields
from envs.options import OptionError, build
from jaxpg.divergence import has_diverged
from jaxpg.shapes import select

MAX_SHARED = 8  # shared environments that are kept


class Single(gymnasium.Env):
    """One environment with brax's interface as a Gymnasium environment.

    Args:
      env: any environment with brax's `reset` and `step`; its `interface`, if it has one, defines the actions.
      bounds: largest magnitude of each observed number, `[n]`; None if unknown.
    """

    metadata = {"render_modes": []}  # noqa: RUF012, as in gymnasium.Env

    def __init__(self, env: Env, bounds: Sequence[float] | None = None):
        self.env = env
        self.observation_space, self.action_space = make_spaces(env, bounds)
        self._functions = compile_functions(env)
        self._state = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """The first observation of an episode; `options` is ignored."""
        super().reset(seed=seed)
        self._state = self._functions.start(draw_seed(seed, self.np_random))
        return _to_observation(self._state), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, float]]:
        """One step under the command `action`; the info holds the environment's metrics."""
        self._state = state = self._functions.step(self._state, _check_command(action, self.action_space))
        info = {name: float(value) for name, value in state.metrics.items()}
        return _to_observation(state), float(state.reward), bool(state.done), False, info


class Batch(gymnasium.vector.VectorEnv):
    """N environments in one compiled step, with Gymnasium's default autoreset.

    The step after the end of an episode resets its environment: it ignores the action, and its reward is 0.

    Args:
      env, bounds: as in `Single`.
      num_envs: N.
      max_episode_steps: time limit; None or -1 for none.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self, env: Env, num_envs: int, max_episode_steps: int | None = None, bounds: Sequence[float] | None = None
    ):
        self.env, self.num_envs = env, num_envs
        self.single_observation_space, self.single_action_space = make_spaces(env, bounds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = np.inf if max_episode_steps in (None, -1) else max_episode_steps
        self._functions = compile_functions(env)
        self._generators = [seeding.np_random()[0] for _ in range(num_envs)]
        self._state, self._time, self._ended = None, np.zeros(num_envs, int), np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """The first observations, `[N, n]`.

        Args:
          seed: seed of the first environment, the others count up from it; or a list of all seeds.
          options: may have `reset_mask`, `[N]` of bool: only these environments are reset. Others are ignored.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        seeds = self._expand_seeds(seed)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i], _ = seeding.np_random(seeds[i])
        fresh = self._functions.starts(self._start_seeds(mask, seeds))
        self._state = fresh if self._state is None else select(jnp.asarray(mask), fresh, self._state)
        self._time[mask], self._ended[mask] = 0, False
        return _to_observation(self._state), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """One step of all environments; rewards, terminations, truncations and metrics in the info are `[N]`."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("reset the environments before their first step")
        begins = self._ended
        seeds = self._start_seeds(begins, [None] * self.num_envs)
        self._state = state = self._functions.steps(
            self._state, _check_command(actions, self.action_space), begins, seeds
        )
        self._time = np.where(begins, 0, self._time + 1)
        terminated, truncated = np.array(state.done, bool), self._time >= self._limit
        self._ended = terminated | truncated
        info = {name: np.array(values, np.float64) for name, values in state.metrics.items()}
        info |= {f"_{name}": ~begins for name in info}  # Gymnasium's mask of the environments that report it
        return _to_observation(state), np.array(state.reward, np.float64), terminated, truncated, info

    def _expand_seeds(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [seed + i for i in range(self.num_envs)]
        seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, one for each environment, not {len(seeds)}")
        return seeds

    def _start_seeds(self, mask: np.ndarray, seeds: Sequence[int | None]) -> np.ndarray:
        """`draw_seed` of each environment of the mask, `[N]`; 0 for the others."""
        triples = zip(mask, seeds, self._generators, strict=True)
        return np.array([draw_seed(seed, random) if wanted else 0 for wanted, seed, random in triples], np.uint32)


class EnvFunctions(NamedTuple):
    """Compiled functions of an environment: `start` and `step` for one, `starts` and `steps` for N.

    Attributes:
      start: `start(seed) -> State`.
      step: `step(state, command) -> State`.
      starts: `starts(seeds[N]) -> State`.
      steps: `steps(state, commands[N, m], begins[N], seeds[N]) -> State`: a start instead where `begins` is true.
    """

    start: Callable[[np.uint32], Any]
    step: Callable[[Any, np.ndarray], Any]
    starts: Callable[[np.ndarray], Any]
    steps: Callable[[Any, np.ndarray, np.ndarray, np.ndarray], Any]


@functools.lru_cache(maxsize=8)
def compile_functions(env: Env) -> EnvFunctions:
    """The compiled functions of an environment, shared by all that use it."""
    limits = find_limits(env)
    scale = np.where(np.isfinite(limits), limits, 1).astype(np.float32)

    def start(seed):
        return env.reset(jax.random.key(seed))

    def step(state, command):
        return step_finite(env, state, command / scale)

    def steps(state, commands, begins, seeds):
        after = jax.vmap(step)(state, commands)
        # Starts cost as much as a step, so they are only computed when an episode begins.
        return jax.lax.cond(begins.any(), lambda: select(begins, jax.vmap(start)(seeds), after), lambda: after)

    return EnvFunctions(jax.jit(start), jax.jit(step), jax.jit(jax.vmap(start)), jax.jit(steps))


def step_finite(env: Env, state: Any, action: jax.Array) -> Any:
    """One step; if the physics diverges, the episode terminates with the previous observation and reward 0.

    As in training, `jaxpg.divergence.has_diverged` decides that.
    """
    after = env.step(state, action)
    is_diverged = has_diverged(state, after)
    return with_fields(
        after,
        obs=jnp.where(is_diverged, state.obs, after.obs),
        reward=jnp.where(is_diverged, 0.0, after.reward),
        done=jnp.where(is_diverged, 1.0, after.done),
    )


def draw_seed(seed: int | None, random: np.random.Generator) -> np.uint32:
    """The seed of an episode's start, drawn unless it is given. JAX's keys use 32 bits of it."""
    return np.uint32(random.integers(2**32) if seed is None else seed % 2**32)


def make_spaces(env: Env, bounds: Sequence[float] | None) -> tuple[Box, Box]:
    """Gymnasium's spaces of the observations within their bounds and the commands within their limits."""
    high = np.array([np.inf] * env.observation_size if bounds is None else bounds, np.float32)
    limits = find_limits(env)
    return Box(-high, high, dtype=np.float32), Box(-limits, limits, dtype=np.float32)


def find_limits(env: Env) -> np.ndarray:
    """The commands at action 1, `[m]`: 1 without an interface, infinity without a limit."""
    limits = interface(env).limits if hasattr(env, "interface") else [1.0] * env.action_size
    return np.array([np.inf] * env.action_size if limits is None else limits, np.float32)


def make(env: str, render_mode: str | None = None, **options: Any) -> Single:
    """The entry point behind `gymnasium.make`.

    Args:
      env: a key of `envs.REGISTRY`.
      render_mode: None.
      **options: options of the environment, by name.

    Raises:
      OptionError: unknown options or values out of range.
      TypeError: a render mode was given; Stable-Baselines3 tries one, and handles this error.
    """
    return Single(*_build(env, render_mode, options))


def make_vec(
    env: str,
    num_envs: int = 1,
    max_episode_steps: int | None = None,
    render_mode: str | None = None,
    **options: Any,
) -> Batch:
    """The entry point behind `gymnasium.make_vec`; arguments and errors as in `make` and `Batch`."""
    env_, bounds = _build(env, render_mode, options)
    return Batch(env_, num_envs, max_episode_steps, bounds)


def _build(name: str, render_mode: str | None, options: dict[str, Any]) -> tuple[Env, list[float] | None]:
    if render_mode is not None:
        raise TypeError(f"render_mode='{render_mode}': these environments cannot render")
    if "episode_length" in options:
        raise OptionError(["episode_length: Gymnasium calls the time limit max_episode_steps"])
    config = build(envs.find(name).config, options)
    return _share_env(name, config), BOUNDS[name](config) if name in BOUNDS else None


_envs: dict[tuple[str, str], Env] = {}  # by name and options, the oldest first


def _share_env(name: str, config: Any) -> Env:
    """One environment for all users of the same options, so that its functions are compiled once."""
    key = name, repr(config)  # the config itself is not hashable if it has lists or is not frozen
    if key not in _envs:
        _envs[key] = envs.make_from_config(name, config)
        if len(_envs) > MAX_SHARED:
            del _envs[next(iter(_envs))]
    return _envs[key]


# Known bounds of observations, by environment: of cosines, sines and clipped speeds.
BOUNDS: dict[str, Callable[[Any], list[float]]] = {
    "pendulum": lambda config: [1.0, 1.0, config.speed_limit],
    "arm": lambda config: [1.0] * 4 + [np.inf] * 6,
}


def _check_command(action: np.ndarray, space: gymnasium.Space) -> np.ndarray:
    command = np.asarray(action, np.float32)
    if command.shape != space.shape:
        raise ValueError(f"expected an action of shape {space.shape}, not {command.shape}")
    return command


def _to_observation(state: Any) -> np.ndarray:
    return np.array(state.obs, np.float32)  # a writable copy for the caller
