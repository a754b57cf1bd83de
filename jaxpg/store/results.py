"""Results of agents and of the settings of a sweep, from the lines of metrics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxpg.config.configuration import Config
from jaxpg.config.sweep import format_setting, list_settings
from jaxpg.store.statistics import has_interval, interquartile_mean, seed_interval, seed_interval_name

Lines = Sequence[dict[str, Any]]
MAX_ROWS = 20  # of the table at the end
MAX_CURVES = 10  # of the figure: one for each colour


def evaluation_returns(lines: Lines) -> np.ndarray:
    """The return of each evaluation, `[K, S]`; NaN if it is not finite."""
    return np.array([np.atleast_1d(line["eval_return"]) for line in lines if "eval_return" in line], float)


def best_returns(lines: Lines) -> np.ndarray:
    """The best evaluation of each agent, `[S]`."""
    return np.atleast_1d(np.fmax.reduce(evaluation_returns(lines), axis=0, initial=-np.inf))


def last_returns(config: Config, lines: Lines) -> np.ndarray:
    """The return of the last evaluation by setting and seed, `[settings, num_seeds]`; NaN if there is none."""
    empty = np.full((1, config.num_agents), np.nan)
    returns = np.concatenate([empty, evaluation_returns(lines).reshape(-1, config.num_agents)])
    return returns[-1].reshape(-1, config.run.num_seeds)


def rank(scores: np.ndarray) -> np.ndarray:
    """The indices of the rows of `[settings, num_seeds]`, best interquartile mean first; NaN is the worst.

    >>> rank(np.array([[1.0, 3.0], [4.0, 2.0], [np.nan, 9.0]])).tolist()
    [1, 0, 2]
    """
    return np.argsort(-np.nan_to_num(interquartile_mean(scores.T), nan=-np.inf), kind="stable")


def make_heading(config: Config) -> str:
    """The heading of the table."""
    number, seeds = len(list_settings(config.sweep)), config.run.num_seeds
    which = f"the best {MAX_ROWS} of {number} settings" if number > MAX_ROWS else "settings, best first"
    interval = f"[{seed_interval_name(seeds)}]" if has_interval(seeds) else f"({seed_interval_name(seeds)})"
    score = f"interquartile mean of {seeds} seeds {interval}" if seeds > 1 else f"seed {config.run.seed}"
    return f"{which}; return of the last evaluation, {score}:"


def make_table(config: Config, lines: Lines) -> dict[str, str]:
    """The best settings, best first, each with its return as `format_score` shows it."""
    returns, names = last_returns(config, lines), list_settings(config.sweep)
    return {format_setting(names[i]): format_score(returns[i]) for i in rank(returns)[:MAX_ROWS]}


def select_curves(config: Config, lines: Lines) -> dict[str, slice]:
    """The best settings, best first, each with its agents."""
    seeds, names = config.run.num_seeds, list_settings(config.sweep)
    return {
        format_setting(names[i]): slice(i * seeds, (i + 1) * seeds)
        for i in rank(last_returns(config, lines))[:MAX_CURVES]
    }


def format_score(values: np.ndarray) -> str:
    """Interquartile mean of the seeds with its 95 % interval, as text; n/a if a value is not finite.

    If there are too few seeds for an interval, the lowest and highest value follow in parentheses.

    >>> [format_score(np.array(values)) for values in ([-2.0], [5.0, 7.0], 6 * [5.0], [np.nan, 5.0])]
    ['-2.0', '6.0 (5.0 to 7.0)', '5.0 [5.0, 5.0]', 'n/a']
    """
    if not np.isfinite(values).all():
        return "n/a"
    mean, (low, high) = f"{interquartile_mean(values):.1f}", seed_interval(values)
    if len(values) == 1:
        return mean
    return f"{mean} [{low:.1f}, {high:.1f}]" if has_interval(len(values)) else f"{mean} ({low:.1f} to {high:.1f})"
