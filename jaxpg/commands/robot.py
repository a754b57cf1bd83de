"""`python -m jaxpg.robot PATH`: what a robot is, whether it can be trained as it is, and what to change in it."""

from __future__ import annotations

import dataclasses
import json
import logging
import math
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import envs
from envs.hints import python_command
from envs.options import OptionError, build
from envs.reach import ReachConfig
from envs.robots import SHIPPED_ROBOTS
from envs.robots.controls import ControlOptions
from jaxpg.commands.options import print_help_if_asked
from jaxpg.config import parsing
from jaxpg.config.command_options import RobotOptions
from jaxpg.errors import UserError

if TYPE_CHECKING:
    from envs.robots.survey import Command, JointEntry, Measurement, OtherActuator, Survey

MAX_PAIRS = 12  # pairs of bodies that are listed
SERVOS = {"motor": "motor", "position": "position servo", "velocity": "velocity servo", "other": "other"}


def main(arguments: Sequence[str]) -> int:
    """The check of a robot; returns its exit status.

    Raises:
      OptionError: the robot cannot be trained as it is, after its table has been printed.
    """
    if print_help_if_asked("robot", "PATH", RobotOptions, arguments):
        return 0
    source, options = _parse(arguments)
    from envs.robots import survey
    from jaxpg.program.backend import prepare

    prepare(parsing.compose(["env=reach"]), threads=1)
    reach = ReachConfig()
    told = ControlOptions(options.control, reach.torque, options.speed, reach.step, reach.dt)
    with _collect_warnings() as lines:
        found = survey.survey_robot(source, options.site, told, options.collision)
        is_measured = options.measure and not found.problems
        measured = survey.measure_step(source, options.collision) if is_measured else None
    notes = [*_select_notes(found, lines), *found.guesses]
    command = _make_command(found, options)
    if options.json:
        print(json.dumps(_summarize(found, measured, notes, command), allow_nan=False))
    else:
        print(_format(found, measured, notes, command))
    if found.problems:
        raise OptionError(found.problems)
    return 0


def _parse(arguments: Sequence[str]) -> tuple[str, RobotOptions]:
    """Where the robot comes from, and the options; raises UserError if there is no robot, or several."""
    paths = [argument for argument in arguments if "=" not in argument or Path(argument).is_file()]
    given = parsing.parse([argument for argument in arguments if argument not in paths])
    options = build(RobotOptions, given)
    sources = [*paths, *([] if options.robot is None else [options.robot])]
    if len(sources) != 1:
        example = f"{python_command()} -m jaxpg.robot {SHIPPED_ROBOTS[0]}"
        what = f"{len(sources)} robots, expected one" if sources else "the robot is missing: its .xml file or its name"
        raise UserError(f"{what}, such as {example}")
    return sources[0], options


@contextmanager
def _collect_warnings() -> Iterator[list[str]]:
    """The lines that the environments log meanwhile, which then are printed nowhere else."""
    lines, logger = [], logging.getLogger("envs")
    handler, propagate = logging.Handler(logging.WARNING), logger.propagate
    handler.emit = lambda record: lines.append(record.getMessage())
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield lines
    finally:
        logger.removeHandler(handler)
        logger.propagate = propagate


def _select_notes(found: Survey, lines: list[str]) -> list[str]:
    """The lines of which nothing else tells."""
    known = [*found.changes, *filter(None, [found.description.reason])]
    notes = [line.removeprefix(f"{found.description.name}: ") for line in dict.fromkeys(lines)]
    return [note for note in notes if not any(each in note for each in known)]


def _make_command(found: Survey, options: RobotOptions) -> str:
    """The command that trains the robot; empty if there is none."""
    if found.problems or not _takes_robots(found.task):
        return ""
    changed = {"robot": found.source}
    if found.task == "reach":
        default = RobotOptions()
        names = ("site", "control", "speed", "collision")
        changed |= {name: getattr(options, name) for name in names if getattr(options, name) != getattr(default, name)}
    words = [f"env={found.task}", *(f"env.{name}={value}" for name, value in changed.items())]
    return f"{python_command()} -m jaxpg.train {shlex.join(words)}"


def _takes_robots(task: str) -> bool:
    """Whether there is an environment called so in which the robot is an option."""
    entry = envs.REGISTRY.get(task)
    return entry is not None and "robot" in [field.name for field in dataclasses.fields(entry.config)]


# --- JSON -------------------------------------------------------------------------------------------------------------


def _summarize(found: Survey, measured: Measurement | None, notes: list[str], command: str) -> dict[str, Any]:
    """All that was found, as plain values; None for a number that is not finite."""
    values = dataclasses.asdict(found) | {"notes": notes, "command": command}
    return _make_plain(values | {"measured": measured and dataclasses.asdict(measured)})


def _make_plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _make_plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_make_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


# --- the table --------------------------------------------------------------------------------------------------------


def _format(found: Survey, measured: Measurement | None, notes: list[str], command: str) -> str:
    """The table as text: a headed block for each kind of part."""
    about = found.description
    base = f"body '{found.base}' moves freely" if found.base else "a fixed base"
    parts = [_count(len(found.joints), "joint"), _count(about.actuators, "actuator"), base]
    blocks = {
        "joints": _format_joints(found.joints),
        "other actuators": [_format_other(each) for each in found.others],
        "sites": [f"{name}{'  (end effector)' if name == found.site else ''}" for name in found.sites],
        "collision": _format_collision(found),
        "physics": _format_physics(found, measured),
        "reach": _format_reach(found),
        "notes": notes,
        "what to change": [*found.problems, *found.changes],
        "train it": [command] if command else [_describe_other_ways(found)],
    }
    lines = [f"{about.name}: {', '.join(parts)}, physics in steps of {found.timestep:g} s"]
    for title, content in blocks.items():
        lines += ["", title, *(f"  {line}" for line in content)] if content else []
    return "\n".join(lines)


def _format_joints(joints: Sequence[JointEntry]) -> list[str]:
    if not joints:
        return []
    head = ("name", "part", "kind", "range", "at rest", "moved by", "", "limits", "set-points")
    return _align([head, *map(_list_cells, joints)])


def _list_cells(joint: JointEntry) -> tuple[str, ...]:
    is_slide, drive = joint.kind == "slide", joint.drive
    unit = "m" if is_slide else "rad"
    limited = "" if joint.rest is None else _format_range(joint.low, joint.high, unit)
    rest = "" if joint.rest is None else f"{joint.rest:.4g}"
    cells = (joint.name, joint.part, joint.kind, limited, rest, joint.actuator or joint.moved_by)
    if drive is None:
        return (*cells, "", "", "")
    torque = _format_range(*drive.torque, "N" if is_slide else "N m")
    points = {"position": unit, "velocity": f"{unit}/s"}.get(drive.kind)
    return (*cells, SERVOS[drive.kind], torque, _format_range(*drive.quantity_range(), points) if points else "")


def _format_other(actuator: OtherActuator) -> str:
    ends = _format_range(actuator.low, actuator.high, "")
    line = f"{actuator.name}: acts on {actuator.target}, range {ends}"
    return line if actuator.kept is None else f"{line}; keeps {actuator.kept:.4g}, as no action commands it"


def _format_collision(found: Survey) -> list[str]:
    about = found.description
    if not about.pairs:
        return ["nothing collides"]
    share = f"{about.candidates} of {about.pairs} pairs of geoms that collide"
    if about.meshes:
        share = f"meshes do not collide; {about.candidates} pairs of other geoms"
    lines = [f"{share} can meet within the joints' ranges"]
    lines += [f"{one} - {other}{f' ({count} pairs)' if count > 1 else ''}" for one, other, count in found.pairs]
    if len(found.pairs) > MAX_PAIRS:
        lines[MAX_PAIRS + 1 :] = [f"and {len(found.pairs) - MAX_PAIRS} more pairs of bodies"]
    return lines


def _format_physics(found: Survey, measured: Measurement | None) -> list[str]:
    about = found.description
    if about.physics == "scalar":
        lines = [f"{about.equations:,} scalar equations"]
        lines += [] if found.differences else ["moves as C MuJoCo does, to 1e-3 over 200 steps from each start"]
    else:
        lines = [f"stepped by C MuJoCo, at its speed and without gradients, because of: {about.reason}"]
    lines += [f"only C MuJoCo has: {feature}" for feature in found.features]
    if measured is not None:
        lines += [
            f"{measured.trace:.1f} s to trace, {measured.compile:.1f} s to compile",
            f"{measured.rate:,.0f} steps/s on one core, 256 environments at once",
        ]
    return lines


def _format_reach(found: Survey) -> list[str]:
    rows = [(f"env.control={each.control}", _format_limits(each)) for each in found.commands]
    lines = _align(rows) if rows else []
    if found.free_share is not None:
        lines.append(f"{found.free_share:.0%} of random poses are free of collisions and above the ground")
    return lines


def _format_limits(command: Command) -> str:
    """The limits by unit: one number if they are the same for all."""
    if command.reason:
        return f"no: {command.reason.partition(': ')[2]}"
    limits: dict[str, list[str]] = {}
    for limit, unit in zip(command.limits, command.units, strict=True):
        limits.setdefault(unit, []).append(f"{limit:.4g}")
    texts = {unit: " ".join(x[:1] if len(set(x)) == 1 else x) for unit, x in limits.items()}
    return f"up to {', '.join(f'{text} {unit}' for unit, text in texts.items())}"


def _describe_other_ways(found: Survey) -> str:
    if found.problems:
        return "not as it is: see above"
    return "no shipped environment takes it; docs/own_environment.md says how to write one"


def _format_range(low: float, high: float, unit: str) -> str:
    if not (math.isfinite(low) or math.isfinite(high)):
        return "any"
    text = f"+-{high:.4g}" if low == -high else f"{low:.4g} to {high:.4g}"
    return f"{text} {unit}".rstrip()


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _align(rows: Sequence[Sequence[str]]) -> list[str]:
    """The rows as lines, with columns as wide as their widest cell; empty columns are left out."""
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    widths = [max(map(len, column)) for column in columns]
    padded = [[cell.ljust(width) for cell in column] for column, width in zip(columns, widths, strict=True)]
    return ["  ".join(row).rstrip() for row in zip(*padded, strict=True)]
