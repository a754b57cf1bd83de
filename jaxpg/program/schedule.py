"""How a run is divided, and where it is on the way: its updates, and what falls with them."""

from __future__ import annotations

from typing import NamedTuple

from jaxpg.config.configuration import Config


class Schedule(NamedTuple):
    """How the updates are divided; the host looks between chunks only.

    Attributes:
      steps_per_update: environment steps of one update (of each agent).
      chunk: updates between two lines of metrics, which come after each multiple of it and after the last update.
      num_updates: updates of the whole run, however it is divided.
      eval_every, checkpoint_every: in chunks.
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
        """Whether something done every `every` chunks is due after `update` updates; at the end it always is."""
        return update >= self.num_updates or update % (self.chunk * every) == 0

    def until_next_line(self, update: int) -> int:
        """Updates from `update` to the next line of metrics; also from within a chunk, where a run may have stopped."""
        return min(self.chunk - update % self.chunk, self.num_updates - update)


def plan(config: Config) -> Schedule:
    """The updates of a run: its steps rounded up to whole updates, and intervals to whole updates and chunks."""
    run = config.run
    steps_per_update = run.num_envs * run.rollout_steps
    num_updates = _ceil(run.total_steps, steps_per_update)
    chunk = min(_ceil(run.log_interval, steps_per_update), num_updates)
    return Schedule(
        steps_per_update=steps_per_update,
        chunk=chunk,
        num_updates=num_updates,
        eval_every=_ceil(run.eval_interval, chunk * steps_per_update),
        checkpoint_every=_ceil(run.checkpoint_interval, chunk * steps_per_update),
    )


def described_jump(before: Config, after: Config, update: int) -> str | None:
    """What jumps where a run goes on with another total, in words; None where nothing does.

    Step sizes and sigma are at any update where a run of the new total, asked for from the beginning, has them.

    Args:
      before, after: the configuration up to now and from now on.
      update: updates made.
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
        jumps.append(f"step sizes are {shares[0]} of the first, not {shares[1]}")
    if network.sigma_is == "scheduled":
        ratio = network.final_sigma / network.sigma
        sigmas = [f"{network.sigma * ratio**progress:.3g}" for progress in (now, was)]
        jumps.append(f"sigma is {sigmas[0]}, not {sigmas[1]}")
    return f"from here on as in a run of {plan(after).total_steps:,} steps: {'; '.join(jumps)}" if jumps else None


def _ceil(a: int, b: int) -> int:
    return -(-a // b)
