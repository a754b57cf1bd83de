"""The environments as Gymnasium's: one of them, or N in one compiled step.

    gymnasium.make("jaxpg/Pendulum-v0", mass=2.0)
    gymnasium.make_vec("jaxpg/Pendulum-v0", num_envs=64)

Importing `jaxpg.gymnasium` registers the names. As in Gymnasium's own Pendulum-v1 an action is the command itself, in
physical units, and the time limit is not the environment's business but Gymnasium's (`max_episode_steps`).

`reset(seed=s)` begins where the environment itself begins with the key of s. Later episodes draw their seeds from
`np_random`, the generator that Gymnasium makes of s; so a batch plays what N environments with the seeds s, s + 1, ...
play one by one. Where the physics diverges the episode is terminated, with the observation before it and the reward 0.
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
from envs.base import interface, with_fields
from envs.options import OptionError, build
from jaxpg.divergence import diverged
from jaxpg.shapes import select

KEPT = 8  # environments that are shared


class Single(gymnasium.Env):
    """One environment of brax's interface as Gymnasium's.

    Args:
      env: any environment with brax's `reset` and `step`; its `interface`, if it has one, says what an action is.
      bounds: the largest magnitude of each number that is observed, `[n]`; None: not known.
    """

    metadata = {"render_modes": []}  # noqa: RUF012, as in gymnasium.Env

    def __init__(self, env: Any, bounds: Sequence[float] | None = None):
        self.env = env
        self.observation_space, self.action_space = spaces(env, bounds)
        self._compiled = compiled(env)
        self._state = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """The first observation of an episode. There are no options: what is given is not looked at."""
        super().reset(seed=seed)
        self._state = self._compiled.start(start_seed(seed, self.np_random))
        return _observed(self._state), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, float]]:
        """One step under the command; the info holds the environment's metrics."""
        self._state = state = self._compiled.step(self._state, _commanded(action, self.action_space))
        info = {name: float(value) for name, value in state.metrics.items()}
        return _observed(state), float(state.reward), bool(state.done), False, info


class Batch(gymnasium.vector.VectorEnv):
    """N environments in one compiled step, with the autoreset that is Gymnasium's default.

    The step after the end of an episode is its environment's reset: the action counts for nothing, the reward is 0.

    Args:
      env, bounds: as in `Single`.
      num_envs: N.
      max_episode_steps: the time limit; None or -1 for none.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self, env: Any, num_envs: int, max_episode_steps: int | None = None, bounds: Sequence[float] | None = None
    ):
        self.env, self.num_envs = env, num_envs
        self.single_observation_space, self.single_action_space = spaces(env, bounds)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._limit = np.inf if max_episode_steps in (None, -1) else max_episode_steps
        self._compiled = compiled(env)
        self._generators = [seeding.np_random()[0] for _ in range(num_envs)]
        self._state, self._time, self._ended = None, np.zeros(num_envs, int), np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """The first observations, `[N, n]`.

        Args:
          seed: of the first environment, after which those of the others are counted up; or a list of all.
          options: `reset_mask`, `[N]` of bool: only these environments are reset. Nothing else is looked at.
        """
        mask = np.asarray((options or {}).get("reset_mask", np.ones(self.num_envs, bool)))
        seeds = self._seeds_of_each(seed)
        for i in np.flatnonzero(mask):
            if seeds[i] is not None:
                self._generators[i], _ = seeding.np_random(seeds[i])
        fresh = self._compiled.starts(self._start_seeds(mask, seeds))
        self._state = fresh if self._state is None else select(mask, fresh, self._state)
        self._time[mask], self._ended[mask] = 0, False
        return _observed(self._state), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """One step of all; rewards, terminations, truncations and the metrics in the info are `[N]`."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("the environments have to be reset before their first step")
        begins = self._ended
        seeds = self._start_seeds(begins, [None] * self.num_envs)
        self._state = state = self._compiled.steps(self._state, _commanded(actions, self.action_space), begins, seeds)
        self._time = np.where(begins, 0, self._time + 1)
        terminated, truncated = np.array(state.done, bool), self._time >= self._limit
        self._ended = terminated | truncated
        info = {name: np.array(values, np.float64) for name, values in state.metrics.items()}
        info |= {f"_{name}": ~begins for name in info}  # Gymnasium's mark of the environments that say it
        return _observed(state), np.array(state.reward, np.float64), terminated, truncated, info

    def _seeds_of_each(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, (int, np.integer)) else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} environments")
        return seeds

    def _start_seeds(self, mask: np.ndarray, seeds: Sequence[int | None]) -> np.ndarray:
        """`start_seed` of each environment of the mask, `[N]`; 0 for the others."""
        each = zip(mask, seeds, self._generators, strict=True)
        return np.array([start_seed(seed, random) if wanted else 0 for wanted, seed, random in each], np.uint32)


class Compiled(NamedTuple):
    """What an environment does, in commands and seeds; `start` and `step` of one, `starts` and `steps` of N.

    Attributes:
      start: `start(seed) -> State`.
      step: `step(state, command) -> State`.
      starts: `starts(seeds[N]) -> State`.
      steps: `steps(state, commands[N, m], begins[N], seeds[N]) -> State`: where `begins` holds, a start instead.
    """

    start: Callable[[np.uint32], Any]
    step: Callable[[Any, np.ndarray], Any]
    starts: Callable[[np.ndarray], Any]
    steps: Callable[[Any, np.ndarray, np.ndarray, np.ndarray], Any]


@functools.lru_cache(maxsize=8)
def compiled(env: Any) -> Compiled:
    """The compiled functions of an environment, the same for all that play it."""
    limits = command_limits(env)
    scale = np.where(np.isfinite(limits), limits, 1).astype(np.float32)

    def start(seed):
        return env.reset(jax.random.key(seed))

    def step(state, command):
        return finite_step(env, state, command / scale)

    def steps(state, commands, begins, seeds):
        after = jax.vmap(step)(state, commands)
        # Starts cost as much as a step: they are computed only where an episode begins.
        return jax.lax.cond(begins.any(), lambda: select(begins, jax.vmap(start)(seeds), after), lambda: after)

    return Compiled(jax.jit(start), jax.jit(step), jax.jit(jax.vmap(start)), jax.jit(steps))


def finite_step(env: Any, state: Any, action: jax.Array) -> Any:
    """The environment's step; physics that diverges ends the episode: the observation before it, no reward, terminated.

    When that is, `jaxpg.divergence.diverged` says, as in training.
    """
    after = env.step(state, action)
    exploded = diverged(state, after)
    return with_fields(
        after,
        obs=jnp.where(exploded, state.obs, after.obs),
        reward=jnp.where(exploded, 0.0, after.reward),
        done=jnp.where(exploded, 1.0, after.done),
    )


def start_seed(seed: int | None, random: np.random.Generator) -> np.uint32:
    """The seed of an episode's start: the one given, or one drawn. JAX's keys take 32 bits of it."""
    return np.uint32(random.integers(2**32) if seed is None else seed % 2**32)


def spaces(env: Any, bounds: Sequence[float] | None) -> tuple[Box, Box]:
    """The observations within their bounds, and the commands within their limits, as Gymnasium's spaces."""
    high = np.array([np.inf] * env.observation_size if bounds is None else bounds, np.float32)
    limits = command_limits(env)
    return Box(-high, high, dtype=np.float32), Box(-limits, limits, dtype=np.float32)


def command_limits(env: Any) -> np.ndarray:
    """The command at action 1 of each `[m]`: 1 where the environment does not say, infinity where there is no limit."""
    limits = interface(env).limits if hasattr(env, "interface") else [1.0] * env.action_size
    return np.array([np.inf] * env.action_size if limits is None else limits, np.float32)


def make(env: str, render_mode: str | None = None, **options: Any) -> Single:
    """The entry point behind `gymnasium.make`.

    Args:
      env: a key of `envs.REGISTRY`.
      render_mode: None.
      **options: the environment's, by name.

    Raises:
      OptionError: unknown options or values out of range.
      TypeError: a render mode; Stable-Baselines3 asks for one, and takes this for an answer.
    """
    return Single(*_built(env, render_mode, options))


def make_vec(
    env: str,
    num_envs: int = 1,
    max_episode_steps: int | None = None,
    render_mode: str | None = None,
    **options: Any,
) -> Batch:
    """The entry point behind `gymnasium.make_vec`; arguments and errors as in `make` and `Batch`."""
    built, bounds = _built(env, render_mode, options)
    return Batch(built, num_envs, max_episode_steps, bounds)


def _built(name: str, render_mode: str | None, options: dict[str, Any]) -> tuple[Any, list[float] | None]:
    if render_mode is not None:
        raise TypeError(f"render_mode='{render_mode}': these environments draw nothing")
    if "episode_length" in options:
        raise OptionError(["episode_length: the time limit is called max_episode_steps in Gymnasium"])
    config = build(envs.find(name).config, options)
    return _shared(name, config), BOUNDS[name](config) if name in BOUNDS else None


_made: dict[tuple[str, str], Any] = {}  # by name and options, the oldest first


def _shared(name: str, config: Any) -> Any:
    """One environment for all that ask for the same options, so that its functions are compiled once."""
    key = name, repr(config)  # which is not hashable itself where it holds lists, or is not frozen
    if key not in _made:
        _made[key] = envs.of_config(name, config)
        if len(_made) > KEPT:
            del _made[next(iter(_made))]
    return _made[key]


# What is known of the magnitude of the observations, by the environment's name: cosines and sines, and clipped speeds.
BOUNDS: dict[str, Callable[[Any], list[float]]] = {
    "pendulum": lambda config: [1.0, 1.0, config.speed_limit],
    "arm": lambda config: [1.0] * 4 + [np.inf] * 6,
}


def _commanded(action: np.ndarray, space: Box) -> np.ndarray:
    command = np.asarray(action, np.float32)
    if command.shape != space.shape:
        raise ValueError(f"an action of shape {command.shape}; the action space has the shape {space.shape}")
    return command


def _observed(state: Any) -> np.ndarray:
    return np.array(state.obs, np.float32)  # the caller's own, to write into
