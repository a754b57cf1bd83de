"""What the registry's entries say to a training, and which program has entered them."""

from __future__ import annotations

import dataclasses
import os
import shlex
import sys
from collections.abc import Iterator, Mapping
from typing import Any

import envs
from envs.hints import python_command
from envs.options import OptionError, build, describe_unknown
from jaxpg.config.entries import GROUPS
from jaxpg.config.schema import Run

PROGRAM = "program"  # in config.yaml: what registered the environment


def training_values(name: str) -> Mapping[str, Mapping[str, Any]]:
    """The training values of the environment `name`, by algorithm.

    All of them are checked, so that a mistake does not wait for its algorithm. A value may be an option of any
    algorithm or network, since several often share theirs; one that the chosen ones do not have counts for nothing.

    Raises:
      OptionError: a line for each that is no option (with the nearest name), or of a wrong type or out of range.
    """
    training = envs.find(name).training
    problems = [f"env={name}, its training values: {problem}" for problem in _problems(name, training)]
    if problems:
        raise OptionError(problems)
    return training


def _problems(name: str, training: Any) -> Iterator[str]:
    if not isinstance(training, Mapping):
        yield f"expected values by algorithm, such as {{'td': {{'num_envs': 64}}}}, not {training!r}"
        return
    schemas = _schemas(name)
    for algo, values in training.items():
        if algo not in GROUPS["algo"]:
            yield describe_unknown("algo", str(algo), GROUPS["algo"])
        elif not isinstance(values, Mapping):
            yield f"{algo}: expected values by option, such as {{'num_envs': 64}}, not {values!r}"
        else:
            for option, value in values.items():
                yield from (f"{algo}: {problem}" for problem in _problems_of_value(algo, option, value, schemas))


def _schemas(env: str) -> dict[str, dict[str, type]]:
    """Option -> where it may come from: the member of its group -> that member's schema."""
    groups = {"": {"": Run}, "env": {env: envs.find(env).config}, "algo": GROUPS["algo"], "network": GROUPS["network"]}
    found: dict[str, dict[str, type]] = {}
    for group, members in groups.items():
        for member, schema in members.items():
            for field in dataclasses.fields(schema):
                found.setdefault(f"{group}.{field.name}".lstrip("."), {})[member] = schema
    return found


def _problems_of_value(algo: str, name: Any, value: Any, schemas: Mapping[str, Mapping[str, type]]) -> Iterator[str]:
    if name == "network":
        if value not in GROUPS["network"]:
            yield describe_unknown("network", str(value), GROUPS["network"])
    elif name not in schemas:
        yield describe_unknown("option", str(name), [*schemas, "network"])
    else:
        group, dot, leaf = name.rpartition(".")
        members = schemas[name]
        try:
            build(members.get(algo, next(iter(members.values()))), {leaf: value}, prefix=group + dot)
        except OptionError as error:
            yield from error.problems


def program_of(env: str) -> dict[str, str]:
    """What goes into config.yaml of the program that registered an environment of somebody's own, and is running."""
    main = sys.modules["__main__"]
    module, path = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    if env in envs.SHIPPED:
        return {}
    if module:
        return {PROGRAM: f"-m {module.name}"}
    return {PROGRAM: os.path.abspath(path)} if path else {}


def command(env: str, verb: str) -> str:
    """How a command about a run of this environment begins, such as `python -m jaxpg.evaluate`."""
    program = program_of(env)
    return _command(program[PROGRAM], verb) if program else f"{python_command()} -m jaxpg.{verb}"


def _command(program: str, verb: str) -> str:
    return f"{python_command()} {program if program.startswith('-m ') else shlex.quote(program)} {verb}"


def check_known(env: str, program: str | None) -> None:
    """Raises OptionError where no environment has the name, with the program that registers it, if that is known."""
    if env in envs.REGISTRY:
        return
    problem = describe_unknown("env", env, envs.REGISTRY).removesuffix("?")
    if program is not None:
        problem = f"unknown env '{env}': {program} registers it"
    instead = f"instead of {python_command()} -m jaxpg.COMMAND say {_command(program or 'SCRIPT', 'COMMAND')}"
    raise OptionError([f"{problem}; {instead}" + ("" if program else ", with the script that registers it")])
