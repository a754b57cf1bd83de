"""What an environment must give: each mistake is a line before anything is compiled; what is as good as right works."""

import inspect
import re
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from environments import SIZES, Point, Position, register
from flax import struct
from hypothesis import given, settings
from hypothesis import strategies as st

import envs
from envs.base import Interface, State, interface
from envs.contract import conform
from envs.options import OptionError
from jaxpg import train
from jaxpg.commands.ending import run_command
from jaxpg.gymnasium_env import Single


def changed(**attributes):
    """An environment class with other attributes than `Point` has."""
    return type("Changed", (Point,), {"__module__": __name__, **attributes})


def problems_of(monkeypatch, build):
    register(monkeypatch, "odd", build)
    with pytest.raises(OptionError) as caught:
        envs.make("odd")
    return caught.value.problems


def from_reset(**fields):
    """A reset that gives these fields instead."""
    return lambda self, rng: Point.reset(self, rng).replace(**fields)


def from_step(**fields):
    return lambda self, state, action: Point.step(self, state, action).replace(**fields)


def branching(self, state, action):
    return state if state.obs[0] > 0 else Point.step(self, state, action)


ONE = jnp.ones(())
MISTAKES = {
    "a dict as observation": ({"observe": lambda self, x: {"x": x, "more": x}}, "obs of reset is a dict: expected one"),
    "a list as observation": ({"observe": lambda self, x: [x, x]}, "obs of reset is a list: expected one array"),
    "an image": ({"observe": lambda self, x: jnp.ones((3, 2)) * x}, "obs of reset is float32[3,2]: expected one array"),
    "a scalar as observation": ({"observe": lambda self, x: x}, "obs of reset is float32[]: expected one array"),
    "a complex observation": ({"observe": lambda self, x: jnp.stack([x, x]) * 1j}, "complex64[2]: expected one array"),
    "another observation_size": ({"observation_size": 3}, "obs of reset is float32[2]: observation_size is 3"),
    "an observation that grows": (
        {"step": from_step(obs=jnp.zeros(3))},
        "obs of step is float32[3]: observation_size is 2",
    ),
    "no observation_size": (
        {"observation_size": None},
        "observation_size is None: expected a whole number, at least 1",
    ),
    "half an action": ({"action_size": 0.5}, "action_size is 0.5: expected a whole number, at least 1"),
    "no action": ({"action_size": 0}, "action_size is 0: expected a whole number, at least 1"),
    "reward of shape (1,)": ({"reward": lambda self, x: x[None]}, "reward of step is float32[1]: expected a scalar"),
    "no reward": ({"reward": lambda self, x: None}, "reward of step is None: expected a scalar"),
    "done of shape (1,)": ({"done": lambda self, x: x[None] > 2}, "done of step is bool[1]: expected a scalar"),
    "a random key as done": (
        {"done": lambda self, x: jax.random.key(0)},
        "done of step is key<fry>[]: expected a scal",
    ),
    "a metric of shape (2,)": (
        {"metrics": lambda self, x: {"distance": jnp.stack([x, x])}},
        "metric 'distance' of step is float32[2]: expected a scalar",
    ),
    "metrics in a tuple": (
        {"metrics": lambda self, x: (x,)},
        "metrics of step are a tuple: expected a dict of scalars",
    ),
    "a metric without a name": ({"metrics": lambda self, x: {3: x}}, "metrics of step: the name 3 is not a string"),
    "a metric that reset has not": (
        {"metrics": lambda self, x: {"distance": x, "height": x}},
        "step returns state.metrics['height'], which reset does not",
    ),
    "a metric that step has not": (
        {"metrics": lambda self, x: {}},
        "step omits state.metrics['distance'], which reset returns",
    ),
    "a state that changes its type": (
        {"step": from_step(pipeline_state=Position(ONE, ONE))},
        "step makes state.pipeline_state.steps float32[], but reset int32[]: they must be the same",
    ),
    "a state that changes its shape": (
        {"step": from_step(pipeline_state=Position(jnp.ones(3), jnp.zeros((), jnp.int32)))},
        "step makes state.pipeline_state.x float32[3], but reset float32[]: they must be the same",
    ),
    "a state of another kind": (
        {"step": from_step(pipeline_state={"x": ONE})},
        "step omits state.pipeline_state.x, which reset returns",
    ),
    "an array instead of a State": (
        {"reset": lambda self, rng: ONE},
        "without obs, reward, done, metrics: expected the fields",
    ),
    "Gymnasium's tuple": (
        {"step": lambda self, state, action: (ONE, ONE, ONE)},
        "step returns a tuple without obs, rew",
    ),
    "names for less": ({"interface": Interface(("x",), ("a",), None)}, "interface.observations is ('x',): expected 2"),
    "one name without its tuple": ({"interface": Interface(("x", "y"), "force", None)}, "interface.commands is"),
    "a limit for less": ({"interface": Interface(("x", "y"), ("a",), ())}, "interface.limits is (): expected 1 finite"),
    "a limit of 0": (
        {"interface": Interface(("x", "y"), ("a",), (0.0,))},
        "expected 1 finite numbers above 0, or None",
    ),
    "a limit of NaN": ({"interface": Interface(("x", "y"), ("a",), (np.nan,))}, "interface.limits is (nan,): expected"),
    "an infinite limit": (
        {"interface": Interface(("x", "y"), ("a",), (np.inf,))},
        "interface.limits is (inf,): expect",
    ),
    "an interface of two": (
        {"interface": (("x", "y"), ("a",))},
        "interface raises ValueError: not enough values to unp",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_one_line(mistake, monkeypatch):
    attributes, message = MISTAKES[mistake]
    problem = problems_of(monkeypatch, changed(**attributes))[0]
    assert problem.startswith("env=odd: ")
    assert message in problem
    assert "\n" not in problem


@pytest.mark.parametrize(
    ("attribute", "function", "named"),
    [
        ("reset", lambda self, rng: (_ for _ in ()).throw(KeyError("goal")), "reset raises KeyError at "),
        ("step", branching, "step, with an action of 1 numbers, raises TracerBoolConversionError at "),
        (
            "__init__",
            lambda self, config: Path("/nowhere/robot.xml").read_text(),
            "its build raises FileNotFoundError at ",
        ),
    ],
)
def test_what_a_users_own_code_raises_is_one_line_with_its_place(attribute, function, named, monkeypatch):
    (problem,) = problems_of(monkeypatch, changed(**{attribute: function}))
    place = re.search(r" at (.*?):(\d+): ", problem)
    assert problem.startswith(f"env=odd: {named}")
    assert place[1] == __file__
    assert 0 <= int(place[2]) - inspect.getsourcelines(function)[1] < 3
    assert "\n" not in problem


def test_its_traceback_is_the_cause_of_that_line(monkeypatch):
    register(monkeypatch, "odd", changed(step=branching))
    with pytest.raises(OptionError) as caught:
        envs.make("odd")
    assert isinstance(caught.value.__cause__, jax.errors.TracerBoolConversionError)


def test_a_mistake_ends_a_training_with_status_2_before_there_is_a_folder(monkeypatch, capsys, tmp_path):
    register(monkeypatch, "odd", changed(reward=lambda self, x: x[None]))
    monkeypatch.setattr(sys, "argv", ["jaxpg", "env=odd", *SIZES, f"run_dir={tmp_path / 'run'}"])
    with pytest.raises(SystemExit) as ending:
        run_command(train.main)
    assert ending.value.code == 2
    assert capsys.readouterr().err.splitlines()[0].startswith("error: env=odd: reward of step is float32[1]")
    assert not (tmp_path / "run").exists()


AS_GOOD_AS_RIGHT = {
    "done that is true or false": {"done": lambda self, x: jnp.abs(x) > 2},
    "done that is 0 or 1": {"done": lambda self, x: (jnp.abs(x) > 2).astype(jnp.int32)},
    "done that is a number of Python's": {"done": lambda self, x: False},
    "whole rewards": {"reward": lambda self, x: jnp.where(jnp.abs(x) < 0.5, 1, 0)},
    "rewards in half precision": {"reward": lambda self, x: (-(x**2)).astype(jnp.float16)},
    "whole observations": {"observe": lambda self, x: jnp.round(100 * jnp.stack([x, x**2])).astype(jnp.int32)},
    "observations in half precision": {"observe": lambda self, x: jnp.stack([x, x**2]).astype(jnp.bfloat16)},
    "metrics that are true or false": {"metrics": lambda self, x: {"distance": jnp.abs(x) < 0.1}},
}


@pytest.mark.parametrize("kind", AS_GOOD_AS_RIGHT)
def test_what_is_as_good_as_right_becomes_floating_point_with_the_same_values(kind, monkeypatch):
    """step after step, against the environment's own numbers; the loop that trains takes it as its carry."""
    own = changed(**AS_GOOD_AS_RIGHT[kind])()
    register(monkeypatch, "odd", lambda config: own)
    env = envs.make("odd")
    state, mine = env.reset(jax.random.key(1)), own.reset(jax.random.key(1))
    for action in jnp.linspace(-1, 1, 5)[:, None]:
        state, mine = env.step(state, action), own.step(mine, action)
        for field in ("obs", "reward", "done"):
            assert getattr(state, field).dtype == jnp.float32
            np.testing.assert_array_equal(getattr(state, field), np.asarray(getattr(mine, field), np.float32))
        assert state.metrics["distance"] == np.asarray(mine.metrics["distance"], np.float32)
        assert isinstance(state, State)
    jax.lax.scan(lambda carry, action: (env.step(carry, action), None), env.reset(jax.random.key(0)), jnp.zeros((3, 1)))


def test_an_environment_gets_its_own_types_back(monkeypatch):
    """One that counts in its observation, and asks its own `done` a bit question, works as it is written."""

    class Counting(Point):
        observation_size = 1

        def reset(self, rng):
            return State(None, jnp.zeros(1, jnp.int32), jnp.zeros(()), jnp.zeros((), bool))

        def step(self, state, action):
            obs = state.obs | 1
            return state.replace(obs=obs << 1, done=state.done | (obs[0] > 4))

    register(monkeypatch, "odd", Counting)
    env = envs.make("odd")
    state = env.reset(jax.random.key(0))
    seen = []
    for _ in range(3):
        state = env.step(state, jnp.zeros(1))
        seen.append((float(state.obs[0]), float(state.done)))
    assert seen == [(2.0, 0.0), (6.0, 0.0), (14.0, 1.0)]


def test_a_sound_environment_is_handed_on_as_it_is(monkeypatch):
    own = Point()
    register(monkeypatch, "odd", lambda config: own)
    assert envs.make("odd") is own


@pytest.mark.parametrize(
    ("name", "options"), [("pendulum", {}), ("arm", {}), ("quadratic", {}), ("brax", {"name": "fast"})]
)
def test_the_environments_that_are_not_looked_at_give_what_they_must(name, options):
    env = envs.make(name, **options)
    assert conform(env, name) is env


@pytest.mark.parametrize("as_kind", [tuple, list, np.array, jnp.array, lambda x: np.array(x, np.float32)[:, None]])
@given(limits=st.lists(st.floats(0.125, 1000, width=16), min_size=1, max_size=3))
@settings(max_examples=10, deadline=None)
def test_limits_of_any_kind_become_plain_numbers(as_kind, limits):
    env = changed(interface=Interface([f"x{i}" for i in range(2)], ["a"] * len(limits), as_kind(limits)))()
    plain = interface(env)
    assert plain == Interface(("x0", "x1"), ("a",) * len(limits), tuple(limits))
    assert all(type(limit) is float for limit in plain.limits)


class Tuple(NamedTuple):
    """A State without brax's `replace`."""

    pipeline_state: jax.Array
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    metrics: dict[str, jax.Array]


class OfTuples:
    observation_size = action_size = 1

    def reset(self, rng):
        return Tuple(ONE, ONE[None], 0 * ONE, ONE > 2, {})

    def step(self, state, action):
        x = state.pipeline_state + action[0]
        return Tuple(x, x[None], -(x**2), x > 2, {})


def test_a_state_may_be_a_named_tuple(monkeypatch):
    register(monkeypatch, "odd", lambda config: OfTuples())
    env = envs.make("odd")
    states = [env.reset(jax.random.key(0))]
    states += [env.step(states[0], jnp.full(1, action)) for action in (0.5, 1.5)]
    assert [float(state.obs[0]) for state in states] == [1.0, 1.5, 2.5]
    assert [(float(state.done), state.done.dtype) for state in states] == [
        (end, jnp.float32) for end in (0.0, 0.0, 1.0)
    ]
    played = Single(env)
    assert played.reset()[0] == 1.0
    assert played.step(np.full(1, 0.5, np.float32))[:3] == (1.5, -2.25, False)


def test_what_else_a_state_of_somebodys_own_holds_must_stay_alike(monkeypatch):
    """A dataclass with a field more, whose name begins as that of another."""

    @struct.dataclass
    class Own:
        obs: jax.Array
        reward: jax.Array
        done: jax.Array
        metrics: dict
        obs_history: jax.Array

    class Other(Point):
        def reset(self, rng):
            return Own(jnp.zeros(2), ONE, ONE > 2, {}, jnp.zeros(2, jnp.int32))

        def step(self, state, action):
            return state.replace(obs_history=state.obs_history + 0.5)

    assert "step makes state.obs_history float32[2]" in problems_of(monkeypatch, Other)[0]


def test_less_is_commanded_than_there_are_actuators(monkeypatch):
    """`action_size` is what the policy commands; another actuator is the environment's business."""

    class Holding(Point):
        interface = Interface(("x", "y"), ("force [N]",), (2.0,))

        def step(self, state, action):
            return super().step(state, jnp.concatenate([action, jnp.zeros(1)]))

    register(monkeypatch, "odd", Holding)
    assert envs.make("odd").action_size == 1
