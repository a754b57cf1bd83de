"""Chatter and the share at a limit are what their definitions say: against plain loops, and at their ends."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxpg.watch.smoothness import chatter, share_at_limit


def by_loops(command, limits, length):
    """Step by step in float64: chatter and share of each episode."""
    found = []
    for n, steps in enumerate(length):
        jumps, at = [], []
        for t in range(steps):
            for i, limit in enumerate(limits):
                now = min(max(command[t, n, i] / limit, -1), 1)
                at.append(abs(now) >= 0.99)
                if t > 0:
                    before = min(max(command[t - 1, n, i] / limit, -1), 1)
                    jumps.append(abs(now - before) / 2)
        found.append((np.mean(jumps) if jumps else np.nan, np.mean(at)))
    return np.array(found).T


@given(st.integers(0, 1000), st.integers(1, 6), st.integers(1, 4), st.integers(1, 3))
@settings(max_examples=50, deadline=None)
def test_both_are_those_of_the_loops(seed, steps, episodes, commands):
    generator = np.random.default_rng(seed)
    limits, length = generator.uniform(0.1, 100, commands), generator.integers(1, steps + 1, episodes)
    command = limits * np.clip(generator.normal(0, 1, (steps, episodes, commands)), -1.5, 1.5)
    expected = by_loops(command, limits, length)
    for t, n in zip(*np.nonzero(np.arange(steps)[:, None] >= length), strict=True):
        command[t, n] = np.nan  # what comes after the end does not count
    np.testing.assert_allclose(chatter(command, limits, length), expected[0], atol=1e-12)
    np.testing.assert_allclose(share_at_limit(command, limits, length), expected[1], atol=1e-12)


def test_the_ends_of_the_scale():
    """Standing still is 0, from limit to limit at every step 1; a slow sine nearly the first."""
    t, limits, length = np.arange(200), np.array([3.0]), np.array([200])
    still, bang, sine = (x[:, None, None] for x in (np.full(200, 3.0), 3.0 * (-1) ** t, np.sin(t / 20)))
    assert chatter(still, limits, length) == pytest.approx(0)
    assert chatter(bang, limits, length) == pytest.approx(1)
    assert 0 < chatter(sine, limits, length)[0] < 0.02
    assert [share_at_limit(x, limits, length)[0] for x in (still, bang, sine)] == [1, 1, 0]
