"""What is said of a sweep's settings at the end."""

import numpy as np
import pytest

from jaxpg.config.parsing import compose
from jaxpg.store.results import MAX_CURVES, MAX_ROWS, best_returns, make_heading, make_table, rank, select_curves
from jaxpg.store.statistics import bootstrap_interval, interquartile_mean
from jaxpg.watch.figures import draw_sweep_curves

CONFIG = compose(["num_seeds=4", "sweep.algo.gamma=[0.5,0.75,1]"])
FIRST = [1.0, 2.0, 3.0, None, 7.0, 5.0, 6.0, 8.0, 0.0, 0.0, 0.0, 0.0]
LAST = [1.0, 1.5, 2.0, 3.0, None, 8.0, 8.0, 8.0, 2.0, 2.5, 3.0, 100.0]
LINES = [
    {"steps": 10, "eval_return": FIRST},
    {"steps": 15, "return": FIRST},
    {"steps": 20, "eval_return": LAST},
]


def test_settings_are_in_order_of_the_interquartile_mean_of_the_last_evaluation():
    """That with a seed that diverged is the last, however good the others are."""
    rows = make_table(CONFIG, LINES)
    assert list(rows) == ["algo.gamma=1.0", "algo.gamma=0.5", "algo.gamma=0.75"]
    assert rows["algo.gamma=1.0"] == f"{interquartile_mean(np.array(LAST[8:])):.1f} (2.0 to 100.0)"
    assert rows["algo.gamma=0.75"] == "n/a"
    assert "interquartile mean of 4 seeds (lowest to highest)" in make_heading(CONFIG)


def test_enough_seeds_have_an_interval():
    values = [float(i) for i in range(8)]
    low, high = bootstrap_interval(np.array(values))
    config = compose(["num_seeds=8", "sweep.algo.gamma=[0.5]"])
    assert make_table(config, [{"eval_return": values}]) == {"algo.gamma=0.5": f"3.5 [{low:.1f}, {high:.1f}]"}
    assert "interquartile mean of 8 seeds [95 % interval]" in make_heading(config)


def test_a_setting_with_one_seed_has_no_interval():
    config = compose(["seed=3", "sweep.algo.gamma=[0.5,0.75]"])
    assert make_table(config, [{"eval_return": [-3.25, 1.0]}]) == {"algo.gamma=0.75": "1.0", "algo.gamma=0.5": "-3.2"}
    assert "return of the last evaluation, seed 3:" in make_heading(config)


def test_of_many_settings_the_best_are_shown():
    number = MAX_ROWS + 5
    config = compose(["sweep.algo.gamma=[" + ",".join(f"{i / 100}" for i in range(number)) + "]"])
    lines = [{"eval_return": np.random.default_rng(0).permutation(number).astype(float).tolist()}]
    rows = make_table(config, lines)
    assert [float(value) for value in rows.values()] == list(range(number - 1, 4, -1))
    assert make_heading(config).startswith(f"the best {MAX_ROWS} of {number} settings")
    assert list(select_curves(config, lines)) == list(rows)[:MAX_CURVES]


def test_a_curve_has_the_agents_of_its_setting():
    for name, agents in select_curves(CONFIG, LINES).items():
        setting = ["algo.gamma=0.5", "algo.gamma=0.75", "algo.gamma=1.0"].index(name)
        assert range(12)[agents] == range(4 * setting, 4 * setting + 4)


def test_the_best_evaluation_of_an_agent_is_that_of_those_with_a_number():
    assert best_returns(LINES).tolist() == [1, 2, 3, 3, 7, 8, 8, 8, 2, 2.5, 3, 100]
    assert best_returns([{"eval_return": None}, {"eval_return": -2.0}]).tolist() == [-2]
    assert best_returns([]).tolist() == [-np.inf]


def test_before_the_first_evaluation_nothing_is_known():
    assert set(make_table(CONFIG, LINES[1:2]).values()) == {"n/a"}


def test_settings_that_differ_in_the_last_digit_are_two():
    config = compose(["sweep.algo.gamma=[0.99999990,0.99999991]"])
    assert list(make_table(config, [{"eval_return": [1.0, 2.0]}])) == ["algo.gamma=0.99999991", "algo.gamma=0.9999999"]


def test_equal_settings_keep_their_order():
    assert rank(np.array([[1.0], [2.0], [1.0], [2.0]])).tolist() == [1, 3, 0, 2]


@pytest.mark.parametrize("lines", [LINES, [line | {"eval_success": [0.5] * 12} for line in LINES]])
def test_a_sweep_is_drawn_where_a_setting_has_diverged(lines, tmp_path):
    draw_sweep_curves(lines, tmp_path / "curves.png", "title", select_curves(CONFIG, lines))
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
