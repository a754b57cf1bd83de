"""What a run that has trained ends with: its learning curve, its table and its page."""

from __future__ import annotations

import io
import shlex
from collections.abc import Callable
from typing import Any

import numpy as np

from jaxpg.config import registered
from jaxpg.program import agents
from jaxpg.run.loop import Session
from jaxpg.run.session import Times
from jaxpg.run.terminal import format_metric
from jaxpg.store import folder, results
from jaxpg.store.folder import to_json
from jaxpg.store.statistics import finite_mean
from jaxpg.watch import figures
from jaxpg.watch.attempts import attempt


def show_results(session: Session, times: Times | None) -> None:
    """The learning curve; and of a run that has just ended the settings of a sweep, the table and the page."""
    config, display, lines = session.config, session.display, draw_learning_curve(session)
    if times is None:
        return
    if config.sweep:
        display.say(results.make_heading(config))
        display.table(results.make_table(config, lines))
    path, env = str(session.run_folder.path), config.choices["env"]
    rows = {
        "speed": f"{times.rate:,.0f} steps/s",
        "time": f"{times.compiling:.1f} s compiling, {times.training:.1f} s training",
        "run folder": path,
        "evaluate it": f"{registered.command(env, 'evaluate')} run={shlex.quote(path)}",
    }
    display.table(_evaluated(lines) | rows)
    if config.run.report:
        _write_report(session)


def _evaluated(lines: list[dict[str, Any]]) -> dict[str, str]:
    """What the evaluations say, the last of which is of the end of the run."""
    last = [line for line in lines if "eval_return" in line][-1]
    best = results.best_returns(lines)
    at_end, at_best = format_metric(last["eval_return"]), format_metric(to_json(best))
    rows = {"deterministic return": f"{at_end} at the end, {at_best} at best"}
    untrained = np.count_nonzero(~np.isfinite(best))
    if untrained:
        whose = f" of {untrained} of the {len(best)} agents" if len(best) > 1 else ""
        rows["best policy"] = f"the untrained one{whose}: in every evaluation all episodes diverged"
    exploded = np.sum(last.get("eval_diverged", 0))
    if exploded:
        rows["diverged"] = f"{exploded:,.0f} episodes of the last evaluation"
    if "eval_success" in last:
        success = finite_mean(np.array(last["eval_success"], float))
        rows["success"] = f"{success:.1%} at the end" if np.isfinite(success) else "n/a"
    return rows


def _write_report(session: Session) -> None:
    """The page of the run."""
    from jaxpg.watch import report

    path, cache, say = str(session.run_folder.path), session.config.run.cache, session.display.say
    attempt("report", lambda: report.of_run(path, None, cache, say), _noting(session))


def _noting(session: Session) -> Callable[[str], None]:
    return lambda line: session.display.say(f"note: {line}")


def draw_learning_curve(session: Session) -> list[dict[str, Any]]:
    """Draws the learning curve, if it can be drawn; returns the lines of metrics that it shows."""
    lines = folder.read_metrics(session.run_folder, session.config.num_agents)
    attempt("learning curve", lambda: _draw_curve(session, lines), _noting(session))
    return lines


def _draw_curve(session: Session, lines: list[dict[str, Any]]) -> None:
    config, title, picture = session.config, agents.described(session.config), io.BytesIO()
    if config.sweep:
        figures.sweep_curves(lines, picture, title, results.select_curves(config, lines))
    else:
        figures.learning_curve(lines, picture, title)
    folder.replace(session.run_folder.learning_curve, picture.getvalue())
