"""`python -m jaxpg.train`: trains an agent and writes a run folder; `--help` lists every option."""

from __future__ import annotations

from collections.abc import Sequence

import envs
from jaxpg.commands.options import check_option_named
from jaxpg.config import help, parsing


def main(arguments: Sequence[str]) -> int:
    """The training command; returns its exit status."""
    if {"--help", "-h"} & set(arguments):
        print(help.train_help([argument for argument in arguments if not argument.startswith("-")]))
        return 0
    from jaxpg.run import session
    from jaxpg.watch.closing import show_results

    check_option_named("resume", arguments)
    given = parsing.parse(arguments)
    if given.get("resume") == "auto":
        asked = parsing.compose([text for text in arguments if text != "resume=auto"])
        return session.begin_or_resume(asked, show_results)
    if "resume" in given:
        return session.resume(given, show_results)
    asked = parsing.compose(arguments)
    if asked.choices["algo"] not in envs.find(asked.choices["env"]).training:
        print(f"env={asked.choices['env']} has no training values for algo={asked.choices['algo']}: the defaults apply")
    return session.begin(asked, show_results)
