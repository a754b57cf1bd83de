"""Random examples in rounds: the first ones are part of the suite, the others are for `pytest -m faults`."""

import pytest
from hypothesis import HealthCheck, Phase, seed, settings


def rounds(few, many):
    """A test of each of `many` rounds, by their `number`; the first `few` are part of the suite."""
    marked = [pytest.param(number, marks=[] if number < few else [pytest.mark.faults]) for number in range(many)]
    return pytest.mark.parametrize("number", marked)


def examples(number, count):
    """The same examples whenever the round is run; what fails is shown as it was found, as each takes seconds."""
    limits = settings(
        max_examples=count,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    return lambda test: seed(number)(limits(test))
