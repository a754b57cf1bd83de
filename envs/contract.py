"""Checks that an environment keeps its contract, before anything is compiled.

`reset` and `step` are only traced for shapes and types, which computes nothing. Each mistake gives a line. What can be
converted, such as a boolean `done` or integer observations, is made floating point here; everything else relies on
`envs.base.State`.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from envs.base import Env, Interface, interface, with_fields
from envs.options import OptionError
from envs.user_code import catch_user_errors

DIMENSIONS = {"obs": 1, "reward": 0, "done": 0}
NUMERIC_FIELDS = (*DIMENSIONS, "metrics")  # fields of a State with numbers for the library
NUMERIC_PATH = re.compile(rf"\.({'|'.join(NUMERIC_FIELDS)})\b")  # paths of their leaves
ADVICE = ("an index or jnp.squeeze makes it a scalar", "jnp.ravel makes it one-dimensional")  # by dimensions


def conform(env: Any, name: str) -> Env:
    """The environment itself, or a wrapper that makes its numbers floating point.

    Args:
      env: has `reset`, `step`, `observation_size` and `action_size`, see `envs.base`.
      name: its name in the registry, for the messages.

    Raises:
      OptionError: a line for each violation of the contract.
    """
    key = jax.eval_shape(jax.random.key, 0)
    with catch_user_errors(name, "reset", env):
        first = jax.eval_shape(env.reset, key)
    _raise_problems(name, _find_state_problems("reset", first))
    sizes = [_read_size(env, name, attribute) for attribute in ("observation_size", "action_size")]
    action = jax.ShapeDtypeStruct((sizes[1],), jnp.float32)
    with catch_user_errors(name, f"step, with an action of {sizes[1]} numbers,", env):
        second = jax.eval_shape(env.step, first, action)
    _raise_problems(name, _find_state_problems("step", second))
    _raise_problems(name, _find_carry_problems(first, second, sizes[0]))
    with catch_user_errors(name, "interface", env):
        env_interface = interface(env)
    _raise_problems(name, _find_interface_problems(env_interface, *sizes))
    if _read_types(first) == _read_types(second) == _find_floating_types(first, second):
        return env
    converted = FloatingEnv(env, first, second)
    with catch_user_errors(name, "step, after itself,", env):
        jax.eval_shape(converted.step, jax.eval_shape(converted.reset, key), action)
    return converted


class FloatingEnv:
    """Wraps an environment so that its observations, rewards, `done` and metrics are floating point.

    Before a step they are cast back, if `reset` and `step` return the same type; this is exact for integers up to 2^24.

    Args:
      env: any environment.
      first, second: shapes and types of the State that its `reset` and its `step` return.
    """

    observation_size: int  # like all that is not here, the environment's own
    action_size: int

    def __init__(self, env: Env, first: Any, second: Any):
        self.env, self._floating_types = env, _find_floating_types(first, second)
        self._env_types = jax.tree.map(
            lambda a, b, other: a if a == b else other, _read_types(first), _read_types(second), self._floating_types
        )

    def reset(self, rng: jax.Array) -> Any:
        return _cast(self.env.reset(rng), self._floating_types)

    def step(self, state: Any, action: jax.Array) -> Any:
        return _cast(self.env.step(_cast(state, self._env_types), action), self._floating_types)

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not set yet while copying
            raise AttributeError(name)
        return getattr(self.env, name)


def _cast(state: Any, types: Mapping[str, Any]) -> Any:
    return with_fields(
        state, **{field: jax.tree.map(jnp.asarray, getattr(state, field), types[field]) for field in NUMERIC_FIELDS}
    )


def _read_types(state: Any) -> dict[str, Any]:
    return {field: jax.tree.map(lambda x: x.dtype, getattr(state, field)) for field in NUMERIC_FIELDS}


def _find_floating_types(first: Any, second: Any) -> dict[str, Any]:
    """The floating point types: single precision, or double if either State has it."""

    def wider(*types):
        return jnp.promote_types(jnp.float32, jnp.promote_types(*types))

    return jax.tree.map(wider, _read_types(first), _read_types(second))


def _raise_problems(name: str, problems: Iterable[str]) -> None:
    lines = [f"env={name}: {problem}" for problem in problems]
    if lines:
        raise OptionError(lines)


def _read_size(env: Any, name: str, attribute: str) -> int:
    with catch_user_errors(name, attribute, env):
        value = getattr(env, attribute)
    try:
        size = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        size = 0
    if size < 1:
        raise OptionError([f"env={name}: {attribute} is {value!r}: expected a whole number, at least 1"])
    return size


def _find_state_problems(function: str, state: Any) -> Iterator[str]:
    missing = [field for field in NUMERIC_FIELDS if not hasattr(state, field)]
    if missing:
        fields = ", ".join(missing)
        yield f"{function} returns {_describe(state)} without {fields}: expected the fields of envs.base.State"
        return
    for field, dimensions in DIMENSIONS.items():
        yield from _find_array_problems(f"{field} of {function}", getattr(state, field), dimensions)
    if not isinstance(state.metrics, Mapping):
        yield f"metrics of {function} are {_describe(state.metrics)}: expected a dict of scalars by name"
        return
    for metric, value in state.metrics.items():
        if not isinstance(metric, str):
            yield f"metrics of {function}: the name {metric!r} is not a string"
        yield from _find_array_problems(f"metric '{metric}' of {function}", value, 0)


def _find_array_problems(what: str, value: Any, dimensions: int) -> Iterator[str]:
    expected = ("a scalar", "one array [observation_size]")[dimensions]
    if not isinstance(value, jax.ShapeDtypeStruct):
        yield f"{what} is {_describe(value)}: expected {expected}" + "; jnp.concatenate joins parts" * dimensions
    elif not any(jnp.issubdtype(value.dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating)):
        yield f"{what} is {_describe(value)}: expected {expected} of real numbers"
    elif value.ndim != dimensions:
        yield f"{what} is {_describe(value)}: expected {expected}; {ADVICE[dimensions]}"


def _find_carry_problems(first: Any, second: Any, observation_size: int) -> Iterator[str]:
    """In a loop one State follows the other, so those of `reset` and `step` must match field by field."""
    for function, state in (("reset", first), ("step", second)):
        if state.obs.shape != (observation_size,):
            yield f"obs of {function} is {_describe(state.obs)}: observation_size is {observation_size}"
    (before, structure), (after, other) = map(_flatten, (first, second))
    yield from (f"step omits state{path}, which reset returns" for path in before if path not in after)
    yield from (f"step returns state{path}, which reset does not" for path in after if path not in before)
    if before.keys() == after.keys() and structure != other:
        yield f"step returns a State with another structure than reset: {other} instead of {structure}"
    for path in (path for path in before if path in after and not NUMERIC_PATH.match(path)):
        a, b = before[path], after[path]
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            yield f"step makes state{path} {_describe(b)}, but reset {_describe(a)}: they must be the same"


def _flatten(state: Any) -> tuple[dict[str, Any], Any]:
    leaves, structure = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}, structure


def _find_interface_problems(env_interface: Interface, observation_size: int, action_size: int) -> Iterator[str]:
    for what, number in (("observations", observation_size), ("commands", action_size)):
        names = getattr(env_interface, what)
        if len(names) != number or not all(isinstance(name, str) for name in names):
            yield f"interface.{what} is {names!r}: expected {number} strings"
    if env_interface.limits is None:
        return
    if len(env_interface.limits) != action_size or not all(0 < limit < math.inf for limit in env_interface.limits):
        yield f"interface.limits is {env_interface.limits!r}: expected {action_size} finite numbers above 0, or None"


def _describe(value: Any) -> str:
    """A description such as `float32[3]` or `a dict`."""
    if isinstance(value, jax.ShapeDtypeStruct):
        return f"{value.dtype.name}[{','.join(map(str, value.shape))}]"
    return "None" if value is None else f"a {type(value).__name__}"
