"""What is shown while a run goes on: the steps of all agents count."""

import re

import pytest

from jaxpg.run import terminal
from jaxpg.run.terminal import Display


@pytest.mark.parametrize("num_agents", [1, 4])
def test_the_rate_counts_the_steps_of_all_agents(num_agents, monkeypatch, capsys):
    """1,000 of 5,000 steps of each agent in 2 s: 500 steps/s an agent, and 8 s are left, however many there are."""
    now = iter([10.0, 10.0, 12.0])
    monkeypatch.setattr(terminal.time, "monotonic", lambda: next(now))
    display = Display(5000, num_agents=num_agents)
    display.start()
    display.update({"steps": 1000, "return": -1.0, "eval_return": -2.0})
    said = capsys.readouterr().out
    assert int(re.search(r"([\d,]+) steps/s", said)[1].replace(",", "")) == 500 * num_agents
    assert "8 s left" in said
