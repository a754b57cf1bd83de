"""`jaxpg VERB ...` or `python -m jaxpg VERB ...`: every command by its verb, as `python -m jaxpg.VERB ...`.

A script of one's own that has registered an environment has all commands with `run_command(main)`:

    python my_robot.py train env=my_robot
    python my_robot.py report run=runs/my_robot
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence

from envs.options import describe_unknown
from jaxpg.commands.ending import run_command
from jaxpg.errors import UserError

VERBS = {
    "robot": "what a robot is, and whether it can be trained",
    "train": "trains an agent, or goes on with a run that was stopped",
    "evaluate": "plays a trained policy",
    "inspect": "what a run is, and whether its checkpoints are sound",
    "report": "the page of a run: curves, episodes to watch",
    "compare": "several runs side by side",
    "render": "a video of a trained policy",
    "view": "a trained policy in MuJoCo's interactive viewer",
    "export": "the policy as C, ONNX or StableHLO",
}


def main(arguments: Sequence[str]) -> int:
    """The command whose verb comes first; returns its exit status."""
    verb, *rest = arguments or ["--help"]
    if verb in ("--help", "-h"):
        lines = [f"  {name:<10} {meaning}" for name, meaning in VERBS.items()]
        print("\n".join(["usage: jaxpg VERB [option=value] ...", "", *lines, "", "jaxpg VERB --help says more"]))
        return 0
    if verb not in VERBS:
        raise UserError(describe_unknown("command", verb, VERBS))
    return importlib.import_module(f"jaxpg.commands.{verb}").main(rest)


def console_script() -> None:
    """The command `jaxpg`, which comes with the package."""
    run_command(main)


if __name__ == "__main__":
    console_script()
