"""`python -m jaxpg.train`: trains an agent and leaves a run folder behind; `--help` lists every option."""

from __future__ import annotations

from collections.abc import Sequence

import envs
from jaxpg.run import config, help
from jaxpg.run.commands import check_named
from jaxpg.run.errors import run_command


def main(arguments: Sequence[str]) -> int:
    """The training command; returns its exit status."""
    if {"--help", "-h"} & set(arguments):
        print(help.train_help([argument for argument in arguments if not argument.startswith("-")]))
        return 0
    from jaxpg.run import session

    check_named("resume", arguments)
    given = config.parse(arguments)
    if given.get("resume") == "auto":
        return session.begin_or_resume(config.compose([text for text in arguments if text != "resume=auto"]))
    if "resume" in given:
        return session.resume(given)
    asked = config.compose(arguments)
    if asked.choices["algo"] not in envs.find(asked.choices["env"]).training:
        print(f"env={asked.choices['env']} has no training values for algo={asked.choices['algo']}: the defaults apply")
    return session.begin(asked)


if __name__ == "__main__":
    run_command(main)
