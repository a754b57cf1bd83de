"""What an environment must give, looked at before anything is compiled.

`reset` and `step` are traced for their shapes and types, which computes nothing. What is wrong is said, a line for each
thing. What is as good as right, such as a `done` that is true or false, or observations that are whole numbers, is made
floating point here, and here only: everything behind it takes what `envs.base.State` says.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from envs.base import Interface, interface, with_fields
from envs.options import OptionError
from envs.user_code import user_code

DIMENSIONS = {"obs": 1, "reward": 0, "done": 0}
MEASURED = (*DIMENSIONS, "metrics")  # the fields of a State that hold numbers for the library
OF_MEASURED = re.compile(rf"\.({'|'.join(MEASURED)})\b")  # paths of their leaves
ADVICE = ("an index or jnp.squeeze makes it a scalar", "jnp.ravel makes it one-dimensional")  # by dimensions


def conform(env: Any, name: str) -> Any:
    """The environment as the library takes it: itself, or with what it measures made floating point.

    Args:
      env: with `reset`, `step`, `observation_size` and `action_size`, see `envs.base`.
      name: in the registry, for the messages.

    Raises:
      OptionError: a line for each thing that an environment must give and this one does not.
    """
    key = jax.eval_shape(jax.random.key, 0)
    with user_code(name, "reset", env):
        first = jax.eval_shape(env.reset, key)
    _refuse(name, _problems_of_state("reset", first))
    sizes = [_size(env, name, attribute) for attribute in ("observation_size", "action_size")]
    action = jax.ShapeDtypeStruct((sizes[1],), jnp.float32)
    with user_code(name, f"step, with an action of {sizes[1]} numbers,", env):
        second = jax.eval_shape(env.step, first, action)
    _refuse(name, _problems_of_state("step", second))
    _refuse(name, _problems_of_carry(first, second, sizes[0]))
    with user_code(name, "interface", env):
        own = interface(env)
    _refuse(name, _problems_of_interface(own, *sizes))
    if _types(first) == _types(second) == _floating(first, second):
        return env
    converted = Converted(env, first, second)
    with user_code(name, "step, after itself,", env):
        jax.eval_shape(converted.step, jax.eval_shape(converted.reset, key), action)
    return converted


class Converted:
    """An environment whose observations, rewards, ends and metrics are floating point; all else is the environment's.

    It gets them back as they were where `reset` and `step` give the same type, which is exact for whole numbers up to
    2^24.

    Args:
      env: any.
      first, second: shapes and types of the State that its `reset` and its `step` give.
    """

    def __init__(self, env: Any, first: Any, second: Any):
        self.env, self._floating = env, _floating(first, second)
        self._own = jax.tree.map(
            lambda a, b, other: a if a == b else other, _types(first), _types(second), self._floating
        )

    def reset(self, rng: jax.Array) -> Any:
        return _cast(self.env.reset(rng), self._floating)

    def step(self, state: Any, action: jax.Array) -> Any:
        return _cast(self.env.step(_cast(state, self._own), action), self._floating)

    def __getattr__(self, name: str) -> Any:
        if name == "env":  # not there yet, as in a copy that is being made
            raise AttributeError(name)
        return getattr(self.env, name)


def _cast(state: Any, types: Mapping[str, Any]) -> Any:
    return with_fields(
        state, **{field: jax.tree.map(jnp.asarray, getattr(state, field), types[field]) for field in MEASURED}
    )


def _types(state: Any) -> dict[str, Any]:
    return {field: jax.tree.map(lambda x: x.dtype, getattr(state, field)) for field in MEASURED}


def _floating(first: Any, second: Any) -> dict[str, Any]:
    """Single precision, or double where either is."""

    def wider(*types):
        return jnp.promote_types(jnp.float32, jnp.promote_types(*types))

    return jax.tree.map(wider, _types(first), _types(second))


def _refuse(name: str, problems: Iterable[str]) -> None:
    lines = [f"env={name}: {problem}" for problem in problems]
    if lines:
        raise OptionError(lines)


def _size(env: Any, name: str, attribute: str) -> int:
    with user_code(name, attribute, env):
        value = getattr(env, attribute)
    try:
        size = 0 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        size = 0
    if size < 1:
        raise OptionError([f"env={name}: {attribute} is {value!r}: expected a whole number, at least 1"])
    return size


def _problems_of_state(function: str, state: Any) -> Iterator[str]:
    missing = [field for field in MEASURED if not hasattr(state, field)]
    if missing:
        yield f"{function} gives {_kind(state)} without {', '.join(missing)}: expected what envs.base.State has"
        return
    for field, dimensions in DIMENSIONS.items():
        yield from _problems_of_array(f"{field} of {function}", getattr(state, field), dimensions)
    if not isinstance(state.metrics, Mapping):
        yield f"metrics of {function} are {_kind(state.metrics)}: expected a dict of scalars by name"
        return
    for metric, value in state.metrics.items():
        if not isinstance(metric, str):
            yield f"metrics of {function}: {metric!r} is no name: expected a text"
        yield from _problems_of_array(f"metric '{metric}' of {function}", value, 0)


def _problems_of_array(what: str, value: Any, dimensions: int) -> Iterator[str]:
    wanted = ("a scalar", "one array [observation_size]")[dimensions]
    if not isinstance(value, jax.ShapeDtypeStruct):
        yield f"{what} is {_kind(value)}: expected {wanted}" + "; jnp.concatenate joins parts" * dimensions
    elif not any(jnp.issubdtype(value.dtype, kind) for kind in (jnp.bool_, jnp.integer, jnp.floating)):
        yield f"{what} is {_kind(value)}: expected {wanted} of real numbers"
    elif value.ndim != dimensions:
        yield f"{what} is {_kind(value)}: expected {wanted}; {ADVICE[dimensions]}"


def _problems_of_carry(first: Any, second: Any, observation_size: int) -> Iterator[str]:
    """The State of `step` must be as that of `reset`, field by field: one follows the other in a loop."""
    for function, state in (("reset", first), ("step", second)):
        if state.obs.shape != (observation_size,):
            yield f"obs of {function} is {_kind(state.obs)}: observation_size is {observation_size}"
    (before, structure), (after, other) = map(_leaves, (first, second))
    yield from (f"step leaves out state{path}, which reset gives" for path in before if path not in after)
    yield from (f"step gives state{path}, which reset does not" for path in after if path not in before)
    if before.keys() == after.keys() and structure != other:
        yield f"step gives a State of another structure than reset: {other} instead of {structure}"
    for path in (path for path in before if path in after and not OF_MEASURED.match(path)):
        a, b = before[path], after[path]
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            yield f"step makes state{path} {_kind(b)}, which is {_kind(a)} after reset: they must be alike"


def _leaves(state: Any) -> tuple[dict[str, Any], Any]:
    leaves, structure = jax.tree_util.tree_flatten_with_path(state)
    return {jax.tree_util.keystr(path): leaf for path, leaf in leaves}, structure


def _problems_of_interface(own: Interface, observation_size: int, action_size: int) -> Iterator[str]:
    for what, number in (("observations", observation_size), ("commands", action_size)):
        names = getattr(own, what)
        if len(names) != number or not all(isinstance(name, str) for name in names):
            yield f"interface.{what} is {names!r}: expected {number} texts"
    if own.limits is None:
        return
    if len(own.limits) != action_size or not all(0 < limit < math.inf for limit in own.limits):
        yield f"interface.limits is {own.limits!r}: expected {action_size} finite numbers above 0, or None"


def _kind(value: Any) -> str:
    """What it is in words, such as `float32[3]` or `a dict`."""
    if isinstance(value, jax.ShapeDtypeStruct):
        return f"{value.dtype.name}[{','.join(map(str, value.shape))}]"
    return "None" if value is None else f"a {type(value).__name__}"
