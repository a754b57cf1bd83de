"""The end of a run: draws its learning curve, prints its table and writes its page."""

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
from jaxpg.store import folder, results, run_files
from jaxpg.store.folder import to_json
from jaxpg.store.statistics import finite_mean
from jaxpg.watch import figures
from jaxpg.watch.attempts import attempt


def show_results(session: Session, times: Times | None) -> None:
    """Draws the learning curve; for a run that has just ended, also prints its tables and writes its page."""
    config, display, lines = session.config, session.display, draw_learning_curve(session)
    if times is None:
        return
    if config.sweep:
        display.say(results.make_heading(config))
        display.show_table(results.make_table(config, lines))
    path, env = str(session.run_folder.path), config.choices["env"]
    rows = {
        "speed": f"{times.rate:,.0f} steps/s",
        "time": f"{times.compiling:.1f} s compiling, {times.training:.1f} s training",
        "run folder": path,
        "evaluate it": f"{registered.format_command(env, 'evaluate')} run={shlex.quote(path)}",
    }
    display.show_table(_summarize_evaluations(lines) | rows)
    if config.run.report:
        _write_report(session)


def _summarize_evaluations(lines: list[dict[str, Any]]) -> dict[str, str]:
    """Rows on the evaluations, the last of which is at the end of the run."""
    last = [line for line in lines if "eval_return" in line][-1]
    best = results.best_returns(lines)
    at_end, at_best = format_metric(last["eval_return"]), format_metric(to_json(best))
    rows = {"deterministic return": f"{at_end} at the end, {at_best} at best"}
    num_untrained = np.count_nonzero(~np.isfinite(best))
    if num_untrained:
        subject = f" of {num_untrained} of the {len(best)} agents" if len(best) > 1 else ""
        rows["best policy"] = f"the untrained one{subject}: in every evaluation all episodes diverged"
    num_diverged = np.sum(last.get("eval_diverged", 0))
    if num_diverged:
        rows["diverged"] = f"{num_diverged:,.0f} episodes of the last evaluation"
    if "eval_success" in last:
        success = finite_mean(np.array(last["eval_success"], float))
        rows["success"] = f"{success:.1%} at the end" if np.isfinite(success) else "n/a"
    return rows


def _write_report(session: Session) -> None:
    """Writes the page of the run."""
    from jaxpg.watch import run_page

    path, cache, say = str(session.run_folder.path), session.config.run.cache, session.display.say
    attempt("report", lambda: run_page.write_report(path, None, cache, say), _make_note_writer(session))


def _make_note_writer(session: Session) -> Callable[[str], None]:
    return lambda line: session.display.say(f"note: {line}")


def draw_learning_curve(session: Session) -> list[dict[str, Any]]:
    """Draws the learning curve if possible; returns its lines of metrics."""
    lines = folder.read_metrics(session.run_folder, session.config.num_agents)
    attempt("learning curve", lambda: _draw_curve(session, lines), _make_note_writer(session))
    return lines


def _draw_curve(session: Session, lines: list[dict[str, Any]]) -> None:
    config, title, picture = session.config, agents.describe_run(session.config), io.BytesIO()
    if config.sweep:
        figures.draw_sweep_curves(lines, picture, title, results.select_curves(config, lines))
    else:
        figures.draw_learning_curve(lines, picture, title)
    run_files.replace(session.run_folder.learning_curve, picture.getvalue())
