"""The options of the commands about a run, each with its default, its help and its range."""

from __future__ import annotations

from dataclasses import dataclass

from envs.options import option


@dataclass(frozen=True)
class EvaluateOptions:
    """Options of the evaluation; options of the environment may be given too, as env.NAME=VALUE."""

    run: str | None = option(None, "run folder; required")
    episodes: int = option(200, "episodes to play", at_least=2)
    seed: int = option(0, "fixes the starts", at_least=0, at_most=2**32 - 1)
    backend: str = option(
        "mjx", "the run's own environment, the same in C MuJoCo, or Gymnasium's", choices=("mjx", "mujoco", "gymnasium")
    )
    policy: str = option("jax", "as trained, or as exported", choices=("jax", "c", "onnx", "stablehlo"))
    checkpoint: str = option(
        "best", "the best policy by the evaluations while training, or the last", choices=("best", "last")
    )
    agent: int | None = option(None, "which of several agents, from 0 [default: the best]", at_least=0)
    cache: bool = option(True, "keep the compiled program in the user's cache folder, for the next evaluation")
    json: bool = option(False, "end with one line of JSON: mean, stderr, success, episodes, diverged")


@dataclass(frozen=True)
class ExportOptions:
    """Options of the export."""

    run: str | None = option(None, "run folder; required")
    format: str = option(
        "c", "a C99 header, an ONNX model, a StableHLO program", choices=("c", "onnx", "stablehlo", "all")
    )
    out: str | None = option(None, "folder to write into [default: export in the run folder]")
    name: str | None = option(None, "what files and C identifiers begin with [default: the environment's name]")
    overwrite: bool = option(False, "replace files there that no export has written, or that were changed since")
    checkpoint: str = option(
        "best", "the best policy by the evaluations while training, or the last", choices=("best", "last")
    )
    agent: int | None = option(None, "which of several agents, from 0 [default: the best]", at_least=0)


@dataclass(frozen=True)
class ReportOptions:
    """Options of the report."""

    run: str | None = option(None, "run folder; required")
    agent: int | None = option(None, "whose episodes, of several agents, from 0 [default: the best's]", at_least=0)
    cache: bool = option(True, "keep compiled programs in the user's cache folder, for the next report")


@dataclass(frozen=True)
class CompareOptions:
    """Options of the comparison."""

    out: str = option("comparison.html", "the page, figure or table to write: .html, .pdf, .svg or .csv")


@dataclass(frozen=True)
class RenderOptions:
    """Options of the video; options of the environment may be given too, as env.NAME=VALUE."""

    run: str | None = option(None, "run folder; required")
    out: str | None = option(None, "file to write, .mp4 or .gif [default: video.mp4 in the run folder]")
    episodes: int = option(4, "episodes side by side", at_least=1, at_most=64)
    seed: int = option(0, "fixes the starts", at_least=0, at_most=2**32 - 1)
    checkpoint: str = option(
        "best",
        "the best policy by the evaluations while training, the last, or the one before",
        choices=("best", "last", "untrained"),
    )
    agent: int | None = option(None, "which of several agents, from 0 [default: the best]", at_least=0)
    width: int = option(360, "of one episode's picture, an even number [pixels]", at_least=16)
    height: int = option(360, "of one episode's picture, an even number [pixels]", at_least=16)
    speed: float = option(1.0, "of the video; 1 is real time", at_least=0.01, at_most=100)
    fps: int = option(60, "pictures a second at most; a GIF has 50", at_least=1, at_most=240)
    cache: bool = option(True, "keep the compiled program in the user's cache folder, for the next video")


@dataclass(frozen=True)
class InspectOptions:
    """Options of the inspection."""

    run: str | None = option(None, "run folder; required")
    json: bool = option(False, "print one line of JSON: step, steps, finished, owner, digest, checkpoints")
