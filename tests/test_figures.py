"""Pictures of a run: a colour means the same in the picture and on the page, and few seeds have no interval."""

import io
import re

import matplotlib.figure
import numpy as np
import pytest

from jaxpg.watch import figures
from jaxpg.watch.page import PARTS

LINES = [{"steps": step, "return": [1.0 * step, 2.0], "eval_return": [3.0, 4.0 * step]} for step in (1, 2, 3)]


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are saved."""
    found = []
    monkeypatch.setattr(matplotlib.figure.Figure, "savefig", lambda self, *_, **__: found.append(self))
    return found


def test_the_colours_are_those_of_the_page():
    style = (PARTS / "page.css").read_text()
    assert re.findall(r"--series-\d: light-dark\((#\w+),", style) == list(figures.COLORS)


def test_the_deterministic_policy_has_the_first_colour_as_on_the_page(drawn):
    figures.draw_learning_curve(LINES, io.BytesIO(), "a run")
    curves = {line.get_label().split(":")[0]: line.get_color() for line in drawn[0].axes[0].get_lines()}
    assert list(curves) == ["deterministic policy", "while training"]
    assert list(curves.values()) == list(figures.COLORS[:2])


@pytest.mark.parametrize(("seeds", "words"), [(2, "lowest to highest"), (5, "lowest to highest"), (6, "95 % interval")])
def test_the_legend_says_what_the_band_is(drawn, seeds, words):
    values = np.random.default_rng(0).normal(size=(3, seeds))
    lines = [{"steps": i, "eval_return": row.tolist()} for i, row in enumerate(values)]
    figures.draw_learning_curve(lines, io.BytesIO(), "a run")
    axes = drawn[0].axes[0]
    assert axes.get_lines()[0].get_label().endswith(f"interquartile mean of {seeds} seeds, {words}")
    band = axes.collections[0].get_paths()[0].vertices
    if seeds < 6:
        assert band[:, 1].max() == values.max()
        assert band[:, 1].min() == values.min()
    else:
        assert band[:, 1].max() < values.max()
