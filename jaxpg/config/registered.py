"""Training values of registered environments, and the programs that registered them."""

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

PROGRAM = "program"  # key in config.yaml: the program that registered the environment


def read_training_values(name: str) -> Mapping[str, Mapping[str, Any]]:
    """The training values of the environment `name`, by algorithm.

    Values of all algorithms are checked, so that a mistake shows early. A value may belong to any algorithm or network,
    since these often share options; it is ignored if the chosen ones lack the option.

    Raises:
      OptionError: lists every unknown option (with the nearest name), wrong type and value out of range.
    """
    training = envs.find(name).training
    problems = [f"env={name}, training values: {problem}" for problem in _find_problems(name, training)]
    if problems:
        raise OptionError(problems)
    return training


def _find_problems(name: str, training: Any) -> Iterator[str]:
    if not isinstance(training, Mapping):
        yield f"expected values by algorithm, such as {{'td': {{'num_envs': 64}}}}, not {training!r}"
        return
    schemas = _collect_schemas(name)
    for algo, values in training.items():
        if algo not in GROUPS["algo"]:
            yield describe_unknown("algo", str(algo), GROUPS["algo"])
        elif not isinstance(values, Mapping):
            yield f"{algo}: expected values by option, such as {{'num_envs': 64}}, not {values!r}"
        else:
            for option, value in values.items():
                yield from (f"{algo}: {problem}" for problem in _find_value_problems(algo, option, value, schemas))


def _collect_schemas(env: str) -> dict[str, dict[str, type]]:
    """Option -> members of its group that have it -> their schemas."""
    groups = {"": {"": Run}, "env": {env: envs.find(env).config}, "algo": GROUPS["algo"], "network": GROUPS["network"]}
    schemas: dict[str, dict[str, type]] = {}
    for group, members in groups.items():
        for member, schema in members.items():
            for field in dataclasses.fields(schema):
                schemas.setdefault(f"{group}.{field.name}".lstrip("."), {})[member] = schema
    return schemas


def _find_value_problems(algo: str, name: Any, value: Any, schemas: Mapping[str, Mapping[str, type]]) -> Iterator[str]:
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


def find_program(env: str) -> dict[str, str]:
    """The entry for config.yaml: the running program, if it registered the environment; else empty."""
    main = sys.modules["__main__"]
    module, path = getattr(main, "__spec__", None), getattr(main, "__file__", None)
    if env in envs.SHIPPED:
        return {}
    if module:
        return {PROGRAM: f"-m {module.name}"}
    return {PROGRAM: os.path.abspath(path)} if path else {}


def format_command(env: str, verb: str) -> str:
    """The start of a command about a run of this environment, such as `python -m jaxpg.evaluate`."""
    program = find_program(env)
    return _format_program_command(program[PROGRAM], verb) if program else f"{python_command()} -m jaxpg.{verb}"


def _format_program_command(program: str, verb: str) -> str:
    return f"{python_command()} {program if program.startswith('-m ') else shlex.quote(program)} {verb}"


def check_registered(env: str, program: str | None) -> None:
    """Raises OptionError if no environment has this name; it names the program that registers it, if known."""
    if env in envs.REGISTRY:
        return
    problem = describe_unknown("env", env, envs.REGISTRY).removesuffix("?")
    if program is not None:
        problem = f"unknown env '{env}': {program} registers it"
    command = _format_program_command(program or "SCRIPT", "COMMAND")
    advice = f"use {command} instead of {python_command()} -m jaxpg.COMMAND"
    raise OptionError([f"{problem}; {advice}" + ("" if program else ", where SCRIPT registers it")])
