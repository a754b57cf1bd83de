"""What the lines of metrics say of the agents, and of the settings of a sweep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.config.sweep import described, settings
from jaxpg.store.statistics import has_interval, interquartile_mean, spread, spread_name

Lines = Sequence[dict[str, Any]]
SHOWN = 20  # settings in the table at the end
DRAWN = 10  # curves in the picture: as many as there are colours


def evaluated(lines: Lines) -> np.ndarray:
    """The return of each evaluation, `[K, S]`; NaN where it is not finite."""
    return np.array([np.atleast_1d(line["eval_return"]) for line in lines if "eval_return" in line], float)


def best_returns(lines: Lines) -> np.ndarray:
    """The best evaluation of each agent, `[S]`."""
    return np.atleast_1d(np.fmax.reduce(evaluated(lines), axis=0, initial=-np.inf))


def scores(config: Config, lines: Lines) -> np.ndarray:
    """The return of the last evaluation by setting and seed, `[settings, num_seeds]`; NaN before the first one."""
    before = np.full((1, config.num_agents), np.nan)
    returns = np.concatenate([before, evaluated(lines).reshape(-1, config.num_agents)])
    return returns[-1].reshape(-1, config.run.num_seeds)


def ranking(scores: np.ndarray) -> np.ndarray:
    """The rows of `[settings, num_seeds]`, that with the best interquartile mean first; NaN is the worst.

    >>> ranking(np.array([[1.0, 3.0], [4.0, 2.0], [np.nan, 9.0]])).tolist()
    [1, 0, 2]
    """
    return np.argsort(-np.nan_to_num(interquartile_mean(scores.T), nan=-np.inf), kind="stable")


def heading(config: Config) -> str:
    """What the table shows."""
    number, seeds = len(settings(config.sweep)), config.run.num_seeds
    which = f"the best {SHOWN} of {number} settings" if number > SHOWN else "settings, the best first"
    around = f"[{spread_name(seeds)}]" if has_interval(seeds) else f"({spread_name(seeds)})"
    of = f"interquartile mean of {seeds} seeds {around}" if seeds > 1 else f"seed {config.run.seed}"
    return f"{which}; return of the last evaluation, {of}:"


def table(config: Config, lines: Lines) -> dict[str, str]:
    """The best settings, the best first: each with its return, as `score` shows it."""
    found, every = scores(config, lines), settings(config.sweep)
    return {described(every[i]): score(found[i]) for i in ranking(found)[:SHOWN]}


def curves(config: Config, lines: Lines) -> dict[str, slice]:
    """The best settings in words, the best first, each with its agents."""
    seeds, every = config.run.num_seeds, settings(config.sweep)
    return {described(every[i]): slice(i * seeds, (i + 1) * seeds) for i in ranking(scores(config, lines))[:DRAWN]}


def score(values: np.ndarray) -> str:
    """Values of the seeds for people: their interquartile mean and its 95 % interval; n/a where one is not finite.

    Too few seeds carry no interval: then their lowest and highest value follow, in parentheses.

    >>> score(np.array([-2.0])), score(np.array([5.0, 7.0])), score(np.full(6, 5.0)), score(np.array([np.nan, 5.0]))
    ('-2.0', '6.0 (5.0 to 7.0)', '5.0 [5.0, 5.0]', 'n/a')
    """
    if not np.isfinite(values).all():
        return "n/a"
    mean, (low, high) = f"{interquartile_mean(values):.1f}", spread(values)
    if len(values) == 1:
        return mean
    return f"{mean} [{low:.1f}, {high:.1f}]" if has_interval(len(values)) else f"{mean} ({low:.1f} to {high:.1f})"
