"""Divides a run into updates and chunks, and describes jumps in its schedules."""

from __future__ import annotations

from typing import NamedTuple

from jaxpg.config.configuration import Config


class Schedule(NamedTuple):
    """How the updates are divided; the host acts only between chunks.

    Attributes:
      steps_per_update: environment steps per update and agent.
      chunk: updates between lines of metrics, which are written after each multiple of it and after the last update.
      num_updates: updates of the whole run.
      eval_every, checkpoint_every: intervals, in chunks.
    """

    steps_per_update: int
    chunk: int
    num_updates: int
    eval_every: int
    checkpoint_every: int

    @property
    def total_steps(self) -> int:
        return self.num_updates * self.steps_per_update

    def is_due(self, update: int, every: int) -> bool:
        """Whether an action that is done every `every` chunks is due after `update` updates; true at the end."""
        return update >= self.num_updates or update % (self.chunk * every) == 0

    def updates_to_next_line(self, update: int) -> int:
        """Updates from `update` to the next line of metrics; a stopped run may resume within a chunk."""
        return min(self.chunk - update % self.chunk, self.num_updates - update)


def plan(config: Config) -> Schedule:
    """The schedule of a run, with steps rounded up to whole updates, and intervals to whole updates and chunks."""
    run = config.run
    steps_per_update = run.num_envs * run.rollout_steps
    num_updates = _divide_up(run.total_steps, steps_per_update)
    chunk = min(_divide_up(run.log_interval, steps_per_update), num_updates)
    return Schedule(
        steps_per_update=steps_per_update,
        chunk=chunk,
        num_updates=num_updates,
        eval_every=_divide_up(run.eval_interval, chunk * steps_per_update),
        checkpoint_every=_divide_up(run.checkpoint_interval, chunk * steps_per_update),
    )


def describe_jump(before: Config, after: Config, update: int) -> str | None:
    """Describes what jumps if a run continues with a different total; None if nothing does.

    Step sizes and sigma are those of a run that had the new total from the beginning.

    Args:
      before, after: the configurations before and after the change.
      update: number of updates made.
    """
    was, now = (min(update / plan(config).num_updates, 1.0) for config in (before, after))
    if was == now:
        return None
    jumps = []
    final_lr, network = after.algo.final_lr, after.network
    if "algo.final_lr" in after.sweep:
        jumps.append("step sizes jump")
    elif final_lr != 1:
        shares = [f"{1 - (1 - final_lr) * progress:.1%}" for progress in (now, was)]
        jumps.append(f"step sizes are {shares[0]} of the initial ones, not {shares[1]}")
    if network.sigma_is == "scheduled":
        ratio = network.final_sigma / network.sigma
        sigmas = [f"{network.sigma * ratio**progress:.3g}" for progress in (now, was)]
        jumps.append(f"sigma is {sigmas[0]}, not {sigmas[1]}")
    return f"continues as in a run of {plan(after).total_steps:,} steps: {'; '.join(jumps)}" if jumps else None


def _divide_up(a: int, b: int) -> int:
    return -(-a // b)
