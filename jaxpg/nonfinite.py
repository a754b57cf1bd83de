"""Numbers that explode: an update with a number in it that is not finite is not applied."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp

from jaxpg.shapes import select
from jaxpg.types import Algorithm, Metrics, PyTree, TrainState

FLAGS = ("nonfinite", "nonfinite_env")  # the metrics that these functions add


def stop_at_nonfinite(algorithm: Algorithm) -> Algorithm:
    """The algorithm, standing still from the first update whose parameters, metrics or observations are not finite.

    Such an update gives back the state as it was, its number included, so the next one is the same again: the caller
    of `step` sees that `update` has not moved.

    Returns:
      `Algorithm(init, step)` with the further metrics `nonfinite`, int32: 0, or 1 + the place in `quantities` of the
      first that is not finite; and `nonfinite_env`, int32: the first environment whose observation is not, or -1.
    """

    def keep(finite: jax.Array, obs_finite: jax.Array, new: TrainState, state: TrainState) -> TrainState:
        return select(finite, new, state)

    return _guard(algorithm, keep)


def skip_nonfinite(algorithm: Algorithm) -> Algorithm:
    """The algorithm without the updates whose parameters, metrics or observations are not finite.

    The environments go on, all that is learned stays as it was, and the next update has other random numbers.

    Returns:
      As `stop_at_nonfinite`.
    """

    def keep(finite: jax.Array, obs_finite: jax.Array, new: TrainState, state: TrainState) -> TrainState:
        kept = select(finite, new, state._replace(update=new.update))
        return kept._replace(env_state=select(obs_finite, new.env_state, state.env_state))

    return _guard(algorithm, keep)


def _guard(algorithm: Algorithm, keep: Callable[..., TrainState]) -> Algorithm:
    """The algorithm with `keep(finite, obs_finite, new, state)` after each update, and with `FLAGS`."""

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        new, metrics = algorithm.step(state, key)
        before, after = _finite_rows(state.env_state.obs), _finite_rows(new.env_state.obs)
        finite_envs = before & after
        flags = [
            jnp.all(finite_envs),
            *(_all_finite(metrics[name]) for name in _order(metrics)),
            _all_finite(new.params),
        ]
        nonfinite = ~jnp.stack(flags)
        finite = ~jnp.any(nonfinite)
        code = jnp.where(finite, 0, 1 + jnp.argmax(nonfinite)).astype(jnp.int32)
        environment = jnp.where(flags[0], -1, jnp.argmin(finite_envs)).astype(jnp.int32)
        return keep(finite, jnp.all(after), new, state), metrics | {"nonfinite": code, "nonfinite_env": environment}

    return Algorithm(algorithm.init, step)


def quantities(metrics: Iterable[str]) -> list[str]:
    """What is looked at, in this order: causes before what is computed from them.

    >>> quantities(["gradient_norm", "nonfinite", "value_loss"])
    ['observation', 'value_loss', 'gradient_norm', 'parameter']
    """
    return ["observation", *_order(metrics), "parameter"]


def _order(metrics: Iterable[str]) -> list[str]:
    return sorted(set(metrics) - set(FLAGS), key=lambda name: (name == "gradient_norm", name))


def _finite_rows(obs: jax.Array) -> jax.Array:
    """Whether all numbers of an environment are finite, `[N]`."""
    return jnp.all(jnp.isfinite(obs).reshape(len(obs), -1), axis=1)


def _all_finite(tree: PyTree) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))
