"""Any configuration either trains or ends in clear lines, one for each mistake, before anything is written.

`pytest -m faults tests/faults` tries a thousand.
"""

import dataclasses
import json
import sys
import types
import typing

import jax
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rounds import examples, rounds

from jaxpg import train
from jaxpg.commands.ending import run_command
from jaxpg.config.entries import GROUPS
from jaxpg.config.schema import Run
from jaxpg.program import compile as program
from jaxpg.store import cache_folder

BASE = {"env": "quadratic", "num_envs": 2, "total_steps": 32, "eval_episodes": 2, "env.episode_length": 4}
BASE |= {"report": "false"}  # which takes longer than such a run
# Where what a run writes goes is not up to chance; and the sizes that cost time are small or impossible.
FIXED = ("run_dir", "loggers", "report", "seed", "cache", "num_seeds", "vmap_seeds", "eval_episodes", "total_steps")
WRONG = st.sampled_from(
    ["nan", "inf", "-1", "0", "true", "null", "many", "[1]", "[]", "1e400", "-0.5", "99999999999999"]
)
FEW, MANY = 1, 21  # rounds of 50 examples, but for the first


def value_of(hint, metadata):
    """A value of the option's type and range."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        (inner,) = [arg for arg in typing.get_args(hint) if arg is not type(None)]
        return st.one_of(st.just("null"), value_of(inner, metadata))
    if metadata["choices"]:
        return st.sampled_from(metadata["choices"])
    if typing.get_origin(hint) is list:
        return st.lists(st.integers(1, 4), max_size=3).map(lambda widths: "[" + ",".join(map(str, widths)) + "]")
    if hint is bool:
        return st.sampled_from(["true", "false"])
    if hint is int:
        return st.integers(1, 6).map(str)
    high = min(x for x in (metadata["at_most"], metadata["below"], 3.0) if x is not None)
    return st.floats(0.01, high).map("{:.4g}".format)


@st.composite
def command_lines(draw):
    """Arguments of a training, most of them right."""
    values = dict(BASE)
    for group in ("algo", "network"):
        values[group] = draw(st.sampled_from([*GROUPS[group], *GROUPS[group], group]))
    schemas = [("", Run), ("env.", GROUPS["env"]["quadratic"])]
    schemas += [(f"{g}.", GROUPS[g][values[g]]) for g in ("algo", "network") if values[g] in GROUPS[g]]
    known = {
        prefix + field.name: value_of(typing.get_type_hints(schema)[field.name], field.metadata)
        for prefix, schema in schemas
        for field in dataclasses.fields(schema)
        if field.name not in FIXED
    }
    for name in draw(st.lists(st.sampled_from(sorted(known)), max_size=5, unique=True)):
        wrong = draw(st.integers(0, 9))
        spelling = name[:-1] if wrong == 0 else name
        values[spelling] = draw(WRONG if wrong == 1 else known[name])
    return [f"{name}={value}" for name, value in values.items()]


@pytest.fixture(autouse=True)
def quick_to_compile(monkeypatch, tmp_path):
    monkeypatch.setattr(program, "OPTIMIZED", program.RUN_ONCE)
    monkeypatch.setattr(cache_folder, "locate", lambda: tmp_path / "cache" / "jaxpg")


@rounds(FEW, MANY)
def test_random_configurations(number, monkeypatch, capsys, tmp_path):
    ended = {0: 0, 2: 0, 4: 0}

    @examples(number, 50 if number else 6)
    @given(command_lines())
    def attempt(arguments):
        folder = tmp_path / f"run-{sum(ended.values())}"
        monkeypatch.setattr(sys, "argv", ["jaxpg", *arguments, f"run_dir={folder}"])
        with pytest.raises(SystemExit) as ending, jax.debug_key_reuse(False):
            run_command(train.main)
        status, said = ending.value.code, capsys.readouterr()
        ended[status] += 1
        if status == 2:
            lines = said.err.splitlines()
            assert lines
            assert all(line.startswith("error: ") for line in lines), said.err
            assert not folder.exists()
        else:
            assert said.err == ""
            lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
            assert lines or status == 4
            assert (folder / "checkpoints").exists()

    attempt()
    if number:
        assert ended[0]
        assert ended[2]
