"""Whether options, a run folder and its checkpoints are of one and the same run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from envs.options import OptionError
from jaxpg.config import configuration
from jaxpg.config.configuration import Config
from jaxpg.errors import UserError
from jaxpg.store.checkpoint_errors import CheckpointError, OtherRunError
from jaxpg.store.folder import RunFolder

if TYPE_CHECKING:  # orbax is slow to import
    from jaxpg.store.checkpoint import Checkpoints

# What may change together with resume=DIR; anything else would be another run.
RESUMABLE = (
    *("total_steps", "log_interval", "eval_interval", "checkpoint_interval"),
    *("stop_return", "stop_agents", "nan_policy", "loggers", "cache", "report"),
)


def check_options(run_folder: RunFolder, stored: Config, config: Config) -> None:
    """Raises UserError where an option differs that would make it another run."""
    differences = _differences(stored, config)
    if differences:
        _, has, given = differences[0]
        raise UserError(f"{given}: {run_folder.path} has {has}, and on resume only {', '.join(RESUMABLE)} may change")


def check_checkpoint(checkpoints: Checkpoints, number: int, config: Config) -> None:
    """Compares the options that a checkpoint was made with.

    Args:
      checkpoints, number: which.
      config: of the run folder.

    Raises:
      OtherRunError: they would make it another run. CheckpointError: it cannot be read, or has none.
    """
    where = checkpoints.folder / str(number)
    try:
        made_with = configuration.from_dict(checkpoints.record(number)["meta"]["config"])
    except (TypeError, KeyError, OptionError) as error:
        raise CheckpointError(f"{where}: has no options that a run could be made with ({error})") from error
    for name, has, given in _differences(made_with, config):
        if name != "run_dir":  # the folder may have been moved
            advice = "put that right, or take away the checkpoint of another run"
            raise OtherRunError(f"{where}: made with {has}, but config.yaml has {given}; {advice}")


def _differences(before: Config, after: Config) -> list[tuple[str, str, str]]:
    """The options that make another run: name, and in words what it was and what it is."""
    old, new = configuration.named(before), configuration.named(after)
    names = [name for name in old | new if name not in RESUMABLE and old.get(name) != new.get(name)]
    return [(name, _in_words(name, old), _in_words(name, new)) for name in names]


def _in_words(name: str, values: Mapping[str, Any]) -> str:
    return f"{name}={values[name]}" if name in values else f"no {name}"
