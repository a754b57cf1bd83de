"""The options of the commands about a run, with their defaults, help and ranges."""

from __future__ import annotations

from dataclasses import dataclass

from envs.options import option
from envs.physics import COLLISION
from envs.robots.controls import CONTROLS

EXPORT_FORMATS = ("c", "onnx", "stablehlo")  # a test compares the names with the table


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the evaluation; env.NAME=VALUE sets an option of the environment."""

    run: str | None = option(None, "run folder; required")
    episodes: int = option(200, "episodes to play", at_least=2)
    seed: int = option(0, "seed of the initial states", at_least=0, at_most=2**32 - 1)
    backend: str = option(
        "mjx", "simulate the run's environment, in C MuJoCo, or in Gymnasium", choices=("mjx", "mujoco", "gymnasium")
    )
    policy: str = option(
        "jax",
        "the trained policy, an export of it, or the environment's textbook controller",
        choices=("jax", *EXPORT_FORMATS, "baseline"),
    )
    checkpoint: str = option(
        "best", "the policy with the best evaluation in training, or the last one", choices=("best", "last")
    )
    agent: int | None = option(None, "index of the agent, from 0 [default: the best]", at_least=0)
    cache: bool = option(True, "keep the compiled program in the user's cache folder")
    json: bool = option(False, "also print one line of JSON: mean, stderr, success, episodes, diverged")


@dataclass(frozen=True)
class ExportOptions:
    """Options of the export."""

    run: str | None = option(None, "run folder; required")
    format: str = option(
        "c", "a C99 header, an ONNX model, a StableHLO program, or all", choices=(*EXPORT_FORMATS, "all")
    )
    out: str | None = option(None, "folder to write into [default: export in the run folder]")
    name: str | None = option(None, "prefix of files and C identifiers [default: the environment's name]")
    overwrite: bool = option(False, "replace files that were not exported, or that were changed since")
    checkpoint: str = option(
        "best", "the policy with the best evaluation in training, or the last one", choices=("best", "last")
    )
    agent: int | None = option(None, "index of the agent, from 0 [default: the best]", at_least=0)


@dataclass(frozen=True)
class ReportOptions:
    """Options of the report."""

    run: str | None = option(None, "run folder; required")
    agent: int | None = option(None, "index of the agent to show, from 0 [default: the best]", at_least=0)
    cache: bool = option(True, "keep compiled programs in the user's cache folder")


@dataclass(frozen=True)
class CompareOptions:
    """Options of the comparison."""

    out: str = option("comparison.html", "page, figure or table to write: .html, .pdf, .svg or .csv")


@dataclass(frozen=True)
class RenderOptions:
    """Options of the video; env.NAME=VALUE sets an option of the environment."""

    run: str | None = option(None, "run folder; required")
    out: str | None = option(None, "file to write, .mp4 or .gif [default: video.mp4 in the run folder]")
    episodes: int = option(4, "episodes side by side", at_least=1, at_most=64)
    seed: int = option(0, "seed of the initial states", at_least=0, at_most=2**32 - 1)
    checkpoint: str = option(
        "best",
        "the policy with the best evaluation in training, the last one, or the untrained one",
        choices=("best", "last", "untrained"),
    )
    agent: int | None = option(None, "index of the agent, from 0 [default: the best]", at_least=0)
    width: int = option(360, "width of each episode's picture, even [pixels]", at_least=16)
    height: int = option(360, "height of each episode's picture, even [pixels]", at_least=16)
    speed: float = option(1.0, "playback speed; 1 is real time", at_least=0.01, at_most=100)
    fps: int = option(60, "maximum frames per second; a GIF has 50", at_least=1, at_most=240)
    cache: bool = option(True, "keep the compiled program in the user's cache folder")


@dataclass(frozen=True)
class RobotOptions:
    """Options of the check of a robot: panda, ur5e, so100, path/to/robot.xml, or menagerie:NAME."""

    robot: str | None = option(None, "the same as PATH")
    site: str = option("", "site or body that is the end effector [default: found by its name]")
    control: str = option("velocity", "what actions shall command in env=reach", choices=CONTROLS)
    speed: float | None = option(None, "largest joint speed [rad/s or m/s] [default: the robot's, or 2]", above=0)
    collision: str = option("primitives", "which geoms collide", choices=COLLISION)
    measure: bool = option(True, "compile the physics, and measure how fast it is")
    json: bool = option(False, "print one line of JSON instead of the table")


@dataclass(frozen=True)
class ViewOptions:
    """Options of the viewer; env.NAME=VALUE sets an option of the environment."""

    run: str | None = option(None, "run folder; required")
    episodes: int = option(8, "episodes, one after the other", at_least=1, at_most=64)
    seed: int = option(0, "seed of the initial states", at_least=0, at_most=2**32 - 1)
    checkpoint: str = option(
        "best",
        "the policy with the best evaluation in training, the last one, or the untrained one",
        choices=("best", "last", "untrained"),
    )
    agent: int | None = option(None, "index of the agent, from 0 [default: the best]", at_least=0)
    speed: float = option(1.0, "playback speed; 1 is real time", at_least=0.01, at_most=100)
    cache: bool = option(True, "keep the compiled program in the user's cache folder")


@dataclass(frozen=True)
class InspectOptions:
    """Options of the inspection."""

    run: str | None = option(None, "run folder; required")
    json: bool = option(False, "print one line of JSON: step, steps, finished, owner, digest, checkpoints")
