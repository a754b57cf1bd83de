"""Options: what is taken for what, and what is said when something is wrong."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from envs.options import (
    OptionError,
    build,
    convert,
    describe,
    describe_range,
    describe_unknown,
    find_declaration_problems,
    find_nearest,
    option,
)


@dataclasses.dataclass(frozen=True)
class Options:
    number: int = option(4, "how many", at_least=1, at_most=10)
    fraction: float = option(0.5, "part", above=0, below=1)
    anything: float = option(0.0, "any number")
    limit: float | None = option(None, "most [N]", above=0)
    widths: list[int] = option([64, 64], "layers", at_least=1)
    flag: bool = option(False, "whether")
    kind: str = option("plain", "which", choices=("plain", "squashed"))
    name: str = option("", "any name")


def problems_of(**overrides):
    with pytest.raises(OptionError) as caught:
        build(Options, overrides)
    return caught.value.problems


@given(st.integers(-(2**53), 2**53))
@settings(max_examples=50, deadline=None)
def test_integral_floats_are_integers_and_integers_are_floats(number):
    """Up to 2^53 every integer is a float64."""
    whole, real = convert(int, float(number)), convert(float, number)
    assert (type(whole), whole) == (int, number)
    assert (type(real), real) == (float, float(number))


@given(st.floats(-1e6, 1e6).filter(lambda x: x != int(x)))
@settings(max_examples=50, deadline=None)
def test_numbers_that_are_not_whole_are_no_integers(number):
    with pytest.raises(ValueError, match=r"^expected a whole number$"):
        convert(int, number)


@pytest.mark.parametrize("value", [True, False, "3", "2.5", "", None, [3], math.nan, math.inf, -math.inf, 3j])
def test_what_is_no_integer(value):
    """True == 1 in Python, but whoever writes true does not mean 1."""
    with pytest.raises(ValueError, match=r"^expected a whole number$"):
        convert(int, value)


@pytest.mark.parametrize("value", [True, "2.5", "inf", None, [1.0]])
def test_what_is_no_number(value):
    with pytest.raises(ValueError, match=r"^expected a number$"):
        convert(float, value)


@pytest.mark.parametrize("value", [0, 1, 1.0, "true", "False", None])
def test_what_is_neither_true_nor_false(value):
    with pytest.raises(ValueError, match=r"^expected true or false$"):
        convert(bool, value)


@pytest.mark.parametrize("value", [1, True, None, ["a"]])
def test_what_is_no_name(value):
    with pytest.raises(ValueError, match=r"^expected a name$"):
        convert(str, value)


@pytest.mark.parametrize(("hint", "value"), [(bool, True), (bool, False), (str, "x"), (str, ""), (int, -3)])
def test_what_has_its_type_is_left_alone(hint, value):
    assert convert(hint, value) is value


@pytest.mark.parametrize("hint", [float | None, int | None, list[int] | None])
def test_none_is_taken_where_it_is_allowed(hint):
    assert convert(hint, None) is None


def test_a_value_that_may_be_none_is_converted_like_any_other():
    assert convert(int | None, 3.0) == 3
    with pytest.raises(ValueError, match=r"^expected a whole number$"):
        convert(int | None, "3")


@pytest.mark.parametrize("value", [[64, 32.0], (64, 32.0)])
def test_lists_are_converted_element_by_element(value):
    converted = convert(list[int], value)
    assert converted == [64, 32]
    assert [type(element) for element in converted] == [int, int]


@pytest.mark.parametrize("value", [64, "64", "[64,64]", None, {64: 1}])
def test_what_is_no_list(value):
    with pytest.raises(ValueError, match=r"^expected a list such as"):
        convert(list[int], value)


@pytest.mark.parametrize("value", [[64, 2.5], [True], [None], [[64]], ["64"]])
def test_a_list_with_one_wrong_element_is_refused(value):
    with pytest.raises(ValueError, match=r"^expected a whole number$"):
        convert(list[int], value)


@pytest.mark.parametrize("name", ["number", "anything"])
def test_an_integer_beyond_any_float_is_a_problem_like_any_other(name):
    assert len(problems_of(**{name: 10**400})) == 1


def test_build_without_overrides_is_the_defaults():
    assert build(Options, {}) == Options()


def test_build_takes_and_converts_what_is_given():
    built = build(Options, {"number": 7.0, "anything": 2, "limit": 3, "widths": (8,), "flag": True, "kind": "squashed"})
    assert built == Options(number=7, anything=2.0, limit=3.0, widths=[8], flag=True, kind="squashed")
    assert type(built.number) is int
    assert type(built.anything) is float


def test_default_lists_are_not_shared():
    first, second = Options(), Options()
    assert first.widths == second.widths == [64, 64]
    assert first.widths is not second.widths


@pytest.mark.parametrize("override", [{"number": 1}, {"number": 10}, {"widths": [1]}, {"widths": []}])
def test_inclusive_bounds_belong_to_the_range(override):
    assert build(Options, override) == Options(**override)


@pytest.mark.parametrize(
    "override", [{"number": 0}, {"number": 11}, {"fraction": 0.0}, {"fraction": 1.0}, {"limit": 0}, {"widths": [4, 0]}]
)
def test_outside_the_range_and_on_exclusive_bounds_is_refused(override):
    ((name, value),) = override.items()
    (problem,) = problems_of(**override)
    assert problem.startswith(f"{name}={value}: must be ")


@given(st.floats(-2, 2))
@settings(max_examples=50, deadline=None)
def test_exclusive_bounds_are_an_open_interval(fraction):
    if 0 < fraction < 1:
        assert build(Options, {"fraction": fraction}).fraction == fraction
    else:
        assert len(problems_of(fraction=fraction)) == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["fraction", "anything", "limit"])
def test_only_finite_numbers_are_allowed(name, value):
    """NaN compares false with every bound, and an option without bounds has none to fail."""
    assert len(problems_of(**{name: value})) == 1


def test_a_number_without_bounds_must_be_finite_in_words():
    assert problems_of(anything=math.nan) == ["anything=nan: must be finite"]


def test_only_the_choices_are_allowed_where_there_are_choices():
    assert problems_of(kind="round") == ["kind=round: must be plain or squashed"]
    assert build(Options, {"name": "round"}).name == "round"


def test_all_problems_are_listed_at_once_and_in_order():
    overrides = {"nunber": 1, "number": 2.5, "flag": True, "fraction": 2, "kind": "round", "limit": "much"}
    problems = problems_of(**overrides)
    wrong = [name for name in overrides if name != "flag"]
    assert len(problems) == len(wrong)
    assert all(name in problem for name, problem in zip(wrong, problems, strict=True))


def test_the_error_is_a_value_error_whose_text_holds_every_problem():
    with pytest.raises(ValueError, match="number") as caught:
        build(Options, {"number": 0, "fraction": 2})
    assert str(caught.value) == "; ".join(caught.value.problems)
    assert "fraction" in str(caught.value)


def test_the_prefix_is_put_before_names_and_suggestions():
    with pytest.raises(OptionError) as caught:
        build(Options, {"fractoin": 0.5, "number": 0}, prefix="env.")
    first, second = caught.value.problems
    assert first == "unknown option 'env.fractoin': did you mean 'env.fraction'?"
    assert second.startswith("env.number=0: must be")


@pytest.mark.parametrize("typo", ["nmber", "numbr", "numbers", "nubmer"])
def test_the_nearest_name_is_suggested(typo):
    assert describe_unknown("option", typo, ["fraction", "number", "limit"]).endswith("did you mean 'number'?")


def test_all_names_are_listed_in_order_where_none_is_near_and_they_are_few():
    assert describe_unknown("env", "qqq", ["pendulum", "arm"]) == "unknown env 'qqq': known are arm, pendulum"


def test_many_names_are_not_listed():
    known = [f"long_name_{i}" for i in range(21)]
    assert describe_unknown("option", "qqq", known[:20]).count("long_name_") == 20
    assert describe_unknown("option", "qqq", known) == "unknown option 'qqq': see --help"


@pytest.mark.parametrize(
    ("bounds", "words"),
    [
        ({}, ""),
        ({"above": 0}, "above 0"),
        ({"at_least": 1, "at_most": 10}, "at least 1, at most 10"),
        ({"above": 0, "below": 1}, "above 0, below 1"),
        ({"choices": ("a", "b", "c")}, "a or b or c"),
    ],
)
def test_ranges_are_described_in_words(bounds, words):
    assert describe_range(option(0, "help", **bounds).metadata) == words


def test_a_bound_of_zero_is_a_bound():
    """0 is false in Python, and None means that there is no bound."""
    assert describe_range({"at_most": 0}) == "at most 0"
    assert len(problems_of(limit=-1)) == 1


def test_help_is_followed_by_the_range_if_there_is_one():
    texts = {field.name: describe(field) for field in dataclasses.fields(Options)}
    assert texts["number"] == "how many (at least 1, at most 10)"
    assert texts["kind"] == "which (plain or squashed)"
    assert texts["anything"] == "any number"


@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("algo.lr", "algo.actor_lr"),
        ("lr", "algo.actor_lr"),
        ("gamma", "algo.gamma"),
        ("gama", "algo.gamma"),
        ("algo.gama", "algo.gamma"),
        ("network.gamma", "algo.gamma"),
        ("alog.gama", "algo.gamma"),
        ("env.seeed", None),
        ("seeed", "seed"),
        ("qqq", None),
        ("algo.qqq", None),
    ],
)
def test_what_is_before_the_dot_says_nothing_of_how_near_a_name_is(name, near):
    known = ["algo.actor_lr", "algo.critic_lr", "algo.gamma", "algo.n", "env.mass", "network.widths", "seed"]
    assert find_nearest(name, known) == near


def test_known_names_of_a_group_are_listed_where_none_is_near():
    known = ["algo.gamma", "algo.n", *(f"network.width_{i}" for i in range(30))]
    assert describe_unknown("option", "algo.qqq", known) == "unknown option 'algo.qqq': known are algo.gamma, algo.n"


@pytest.mark.parametrize("kind", [np.int64, np.uint8, np.float32, np.float64])
def test_numbers_of_numpy_are_numbers(kind):
    assert type(convert(int, kind(3))) is int
    assert type(convert(float, kind(3))) is float


@given(st.integers(-1000, 1000) | st.floats(-1e3, 1e3) | st.none() | st.text(max_size=3) | st.booleans())
@settings(max_examples=100, deadline=None)
def test_of_several_types_a_value_is_of_the_first_that_it_fits(value):
    fits = next((kind for kind in (int, float, str, type(None)) if _fits(kind, value)), None)
    if fits is None:
        with pytest.raises(ValueError, match=r"^expected a whole number or a number or a name$"):
            convert(int | float | str | None, value)
    else:
        found = convert(int | float | str | None, value)
        assert (type(found), found) == (fits, value)


def _fits(kind, value):
    try:
        convert(kind, value)
    except ValueError:
        return False
    return True


@given(st.lists(st.integers(-5, 5), max_size=4))
@settings(max_examples=50, deadline=None)
def test_tuples_have_as_many_elements_as_their_type_says(values):
    assert convert(tuple[int, ...], values) == tuple(values)
    if len(values) == 2:
        assert convert(tuple[int, float], values) == (values[0], float(values[1]))
    else:
        with pytest.raises(ValueError, match=r"^expected a list of 2 values$"):
            convert(tuple[int, float], values)


def test_a_field_without_option_has_neither_help_nor_range():
    plain = dataclasses.make_dataclass("Plain", [("force", float, 5.0)])
    (field,) = dataclasses.fields(plain)
    assert describe(field) == ""
    assert build(plain, {"force": -1e9}) == plain(-1e9)


def test_options_are_declared_without_problems():
    assert list(find_declaration_problems(Options)) == []


@pytest.mark.parametrize("default", [-1.0, "much", None])
def test_a_default_that_the_option_cannot_have_is_a_problem(default):
    kind = dataclasses.make_dataclass("Kind", [("mass", float, option(default, "of the link", above=0))])
    (problem,) = find_declaration_problems(kind)
    assert problem.startswith(f"option 'mass': its default {default!r}: ")
