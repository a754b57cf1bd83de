"""The ladder of estimators on a linear-quadratic problem: mean, bias and variance of each, against theory.

    python experiments/estimator_table.py

A million trajectories of five steps, of a random problem with one and with three state variables, discount 0.8, the
same for all estimators. Errors: how far the mean of the gradient is from the one that theory gives the estimator, in
standard errors, in the component where it is furthest. Bias: how far that mean is from the gradient of J, over that
gradient's length, by the formula and as measured; without the factors gamma^t there is some, whatever the baseline.
Variance: of all components together, over that of the returns with the factors and without a baseline.

Writes results/estimator_table.json and prints it as a table.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from commands import Parser, write_json
from linear_quadratic import closed_form, ladder, setting, study

from jaxpg.commands.ending import run_command

NUM_BATCHES = 20
SIZES = (1, 3)


def rows(n: int) -> dict[str, dict[str, float]]:
    case = setting(n)
    rungs, exact = ladder(case), closed_form(case)
    measured, length = study(case, rungs, NUM_BATCHES), np.linalg.norm(exact)
    reference = np.trace(measured["returns"].covariance)
    return {
        name: {
            "errors": round(float(np.abs(found.errors(rungs[name].expected)).max()), 2),
            "bias": round(float(np.linalg.norm(rungs[name].expected - exact) / length), 3),
            "measured bias": round(float(np.linalg.norm(found.mean - exact) / length), 3),
            "variance": round(float(np.trace(found.covariance) / reference), 4),
        }
        for name, found in measured.items()
    }


def main(arguments: Sequence[str] = ()) -> None:
    Parser(__doc__).parse_args(arguments)
    by_size = {n: rows(n) for n in SIZES}
    table = {name: {f"n = {n}": by_size[n][name] for n in SIZES} for name in by_size[SIZES[0]]}
    write_json("estimator_table.json", table)
    columns = [(f"n = {n}", column) for n in SIZES for column in ("errors", "bias", "measured bias", "variance")]
    print("| estimator | " + " | ".join(f"{column}, {size}" for size, column in columns) + " |")
    print("|---" * (1 + len(columns)) + "|")
    for name, row in table.items():
        print(f"| {name} | " + " | ".join(str(row[size][column]) for size, column in columns) + " |")


if __name__ == "__main__":
    run_command(main)
