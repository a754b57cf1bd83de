"""Numbers that explode: an update with a number in it that is not finite is not applied."""

from __future__ import annotations

from collections.abc import Iterable

import jax
import jax.numpy as jnp

from jaxpg.types import Algorithm, Metrics, PyTree, TrainState

POLICIES = ("stop", "skip")
FLAGS = ("unsound", "unsound_env")  # the metrics that `sound` adds


def sound(algorithm: Algorithm, policy: str = "stop") -> Algorithm:
    """The algorithm without the updates whose parameters, metrics or observations are not finite.

    With "stop" such an update gives back the state as it was, its number included, so that the next one is the same
    again and the training stands still: whoever calls `step` sees that `update` has not moved. With "skip" the
    environments go on, all that is learned stays as it was, and the next update has other random numbers.

    Args:
      algorithm: what to watch.
      policy: a name in `POLICIES`.

    Returns:
      `Algorithm(init, step)` with the further metrics `unsound`, int32: 0, or 1 + the place in `quantities` of the
      first that is not finite; and `unsound_env`, int32: the first environment whose observation is not, or -1.

    Raises:
      ValueError: an unknown policy.
    """
    if policy not in POLICIES:
        raise ValueError(f"policy is {policy!r}; it must be one of {', '.join(POLICIES)}")

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        new, metrics = algorithm.step(state, key)
        good_before, good_after = _each_finite(state.env_state.obs), _each_finite(new.env_state.obs)
        good_envs = good_before & good_after
        flags = [jnp.all(good_envs), *(_finite(metrics[name]) for name in _in_order(metrics)), _finite(new.params)]
        bad = ~jnp.stack(flags)
        is_sound = ~jnp.any(bad)
        if policy == "stop":
            kept = _where(is_sound, new, state)
        else:
            kept = _where(is_sound, new, state._replace(update=new.update))
            kept = kept._replace(env_state=_where(jnp.all(good_after), new.env_state, state.env_state))
        seen = jnp.where(is_sound, 0, 1 + jnp.argmax(bad)).astype(jnp.int32)
        environment = jnp.where(flags[0], -1, jnp.argmin(good_envs)).astype(jnp.int32)
        return kept, metrics | {"unsound": seen, "unsound_env": environment}

    return Algorithm(algorithm.init, step)


def quantities(metrics: Iterable[str]) -> list[str]:
    """What `sound` looks at, in its order: what the others are made of first.

    >>> quantities(["gradient_norm", "unsound", "value_loss"])
    ['observation', 'value_loss', 'gradient_norm', 'parameter']
    """
    return ["observation", *_in_order(metrics), "parameter"]


def _in_order(metrics: Iterable[str]) -> list[str]:
    return sorted(set(metrics) - set(FLAGS), key=lambda name: (name == "gradient_norm", name))


def _each_finite(obs: jax.Array) -> jax.Array:
    """Whether all numbers of an environment are finite, `[N]`."""
    return jnp.all(jnp.isfinite(obs).reshape(len(obs), -1), axis=1)


def _finite(tree: PyTree) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))


def _where(condition: jax.Array, if_true: PyTree, if_false: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)
