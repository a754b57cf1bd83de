"""`python -m jaxpg.train`: trains an agent and writes a run folder; `--help` lists every option."""

from __future__ import annotations

from collections.abc import Sequence

import envs
from jaxpg.commands.options import check_option_named
from jaxpg.config import help, parsing


def main(arguments: Sequence[str]) -> int:
    """The training command; returns its exit status."""
    if {"--help", "-h"} & set(arguments):
        print(help.format_train_help([argument for argument in arguments if not argument.startswith("-")]))
        return 0
    from jaxpg.run import session
    from jaxpg.watch.closing import show_results

    check_option_named("resume", arguments)
    options = parsing.parse(arguments)
    if options.get("resume") == "auto":
        config = parsing.compose([text for text in arguments if text != "resume=auto"])
        return session.begin_or_resume(config, show_results)
    if "resume" in options:
        return session.resume(options, show_results)
    config = parsing.compose(arguments)
    if config.choices["algo"] not in envs.find(config.choices["env"]).training:
        env, algo = config.choices["env"], config.choices["algo"]
        print(f"env={env} has no training values for algo={algo}: the defaults apply")
    return session.begin(config, show_results)
