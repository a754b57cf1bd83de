"""Checks that options, a run folder and its checkpoints belong to the same run."""

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

# Options that may change with resume=DIR; changing any other would make it another run.
RESUMABLE = (
    *("total_steps", "log_interval", "eval_interval", "checkpoint_interval"),
    *("stop_return", "stop_agents", "nan_policy", "loggers", "cache", "report"),
)


def check_options(run_folder: RunFolder, stored: Config, config: Config) -> None:
    """Raises UserError if an option differs that may not change on resume."""
    differences = _find_differences(stored, config)
    if differences:
        _, old, new = differences[0]
        raise UserError(f"{new}: {run_folder.path} has {old}, and on resume only {', '.join(RESUMABLE)} may change")


def check_checkpoint(checkpoints: Checkpoints, number: int, config: Config) -> None:
    """Checks that a checkpoint was made with the options of the run folder.

    Args:
      checkpoints, number: the checkpoint.
      config: configuration of the run folder.

    Raises:
      OtherRunError: its options belong to another run.
      CheckpointError: it cannot be read, or has no options.
    """
    where = checkpoints.folder / str(number)
    try:
        made_with = configuration.from_dict(checkpoints.record(number)["meta"]["config"])
    except (TypeError, KeyError, OptionError) as error:
        raise CheckpointError(f"{where}: its options are not those of a run ({error})") from error
    for name, old, new in _find_differences(made_with, config):
        if name != "run_dir":  # the folder may have been moved
            advice = "correct it, or remove the checkpoint of another run"
            raise OtherRunError(f"{where}: made with {old}, but config.yaml has {new}; {advice}")


def _find_differences(before: Config, after: Config) -> list[tuple[str, str, str]]:
    """The differing options that make it another run: name, and descriptions of the old and the new value."""
    old, new = configuration.to_arguments(before), configuration.to_arguments(after)
    names = [name for name in old | new if name not in RESUMABLE and old.get(name) != new.get(name)]
    return [(name, _describe(name, old), _describe(name, new)) for name in names]


def _describe(name: str, values: Mapping[str, Any]) -> str:
    return f"{name}={values[name]}" if name in values else f"no {name}"
