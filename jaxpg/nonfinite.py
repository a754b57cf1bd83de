"""Guards an algorithm against numbers that are not finite: updates with such numbers are not applied."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp

from jaxpg.shapes import select
from jaxpg.types import Algorithm, Metrics, PyTree, TrainState

FLAGS = ("nonfinite", "nonfinite_env")  # metrics that these functions add


def stop_at_nonfinite(algorithm: Algorithm) -> Algorithm:
    """Stops the algorithm at the first update whose parameters, metrics or observations are not finite.

    Such an update returns its state unchanged, including `update`, so all later ones repeat it. Callers of `step` can
    tell from `update`.

    Returns:
      `Algorithm(init, step)` with two more metrics, int32. `nonfinite` is 0, or 1 + the index in `list_quantities` of
      the first one that is not finite. `nonfinite_env` is the first environment whose observation is not finite, or -1.
    """

    def keep(finite: jax.Array, obs_finite: jax.Array, new: TrainState, state: TrainState) -> TrainState:
        return select(finite, new, state)

    return _guard(algorithm, keep)


def skip_nonfinite(algorithm: Algorithm) -> Algorithm:
    """Skips the updates whose parameters, metrics or observations are not finite.

    In such an update the environments advance and nothing is learned; the next one has different random numbers.

    Returns:
      As `stop_at_nonfinite`.
    """

    def keep(finite: jax.Array, obs_finite: jax.Array, new: TrainState, state: TrainState) -> TrainState:
        chosen = select(finite, new, state._replace(update=new.update))
        return chosen._replace(env_state=select(obs_finite, new.env_state, state.env_state))

    return _guard(algorithm, keep)


def _guard(algorithm: Algorithm, keep: Callable[..., TrainState]) -> Algorithm:
    """Applies `keep(finite, obs_finite, new, state)` after each update, and adds `FLAGS` to the metrics."""

    def step(state: TrainState, key: jax.Array) -> tuple[TrainState, Metrics]:
        new, metrics = algorithm.step(state, key)
        before, after = _find_finite_rows(state.env_state.obs), _find_finite_rows(new.env_state.obs)
        finite_envs = before & after
        flags = [
            jnp.all(finite_envs),
            *(_is_finite(metrics[name]) for name in _sort_metrics(metrics)),
            _is_finite(new.params),
        ]
        nonfinite = ~jnp.stack(flags)
        finite = ~jnp.any(nonfinite)
        code = jnp.where(finite, 0, 1 + jnp.argmax(nonfinite)).astype(jnp.int32)
        environment = jnp.where(flags[0], -1, jnp.argmin(finite_envs)).astype(jnp.int32)
        return keep(finite, jnp.all(after), new, state), metrics | {"nonfinite": code, "nonfinite_env": environment}

    return Algorithm(algorithm.init, step)


def list_quantities(metrics: Iterable[str]) -> list[str]:
    """The quantities that are checked, in order: causes before their effects.

    >>> list_quantities(["gradient_norm", "nonfinite", "value_loss"])
    ['observation', 'value_loss', 'gradient_norm', 'parameter']
    """
    return ["observation", *_sort_metrics(metrics), "parameter"]


def _sort_metrics(metrics: Iterable[str]) -> list[str]:
    return sorted(set(metrics) - set(FLAGS), key=lambda name: (name == "gradient_norm", name))


def _find_finite_rows(obs: jax.Array) -> jax.Array:
    """Whether all numbers of each environment are finite, `[N]`."""
    return jnp.all(jnp.isfinite(obs).reshape(len(obs), -1), axis=1)


def _is_finite(tree: PyTree) -> jax.Array:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]))
