"""The ladder of estimators on a linear-quadratic problem: mean, bias and variance of each, against theory.

    python experiments/estimator_table.py

A million trajectories of five steps, of a random problem with one and with three variables, discount 0.8, the same for
all estimators. Errors: how far the mean of the gradient is from the one that theory gives the estimator, in standard
errors, in the component where it is furthest. Bias: how far that mean is from the gradient that it should be (with the
factors gamma^t of J, without them of the undiscounted sum), over that gradient's length. Variance: of all components
together, over that of the returns without a baseline.

Writes results/estimator_table.json and prints it as a table.
"""

from __future__ import annotations

import numpy as np
from commands import write_json
from linear_quadratic import LADDER, measure

NUM_BATCHES = 20
SIZES = (1, 3)


def main() -> None:
    table = {name: {} for name in LADDER}
    for n in SIZES:
        moments = measure(n, NUM_BATCHES)
        reference = moments["returns"].variance.sum()
        for name, found in moments.items():
            expected, right = LADDER[name].mean(n), LADDER[name].target(n)
            table[name][f"n = {n}"] = {
                "errors": round(float(np.abs(found.errors(expected)).max()), 2),
                "bias": round(float(np.linalg.norm(expected - right) / np.linalg.norm(right)), 3),
                "measured bias": round(float(np.linalg.norm(found.mean - right) / np.linalg.norm(right)), 3),
                "variance": round(float(found.variance.sum() / reference), 4),
            }
    write_json("estimator_table.json", table)
    columns = [(n, column) for n in SIZES for column in ("errors", "bias", "measured bias", "variance")]
    print("| estimator | " + " | ".join(f"{column}, n = {n}" for n, column in columns) + " |")
    print("|---" * (1 + len(columns)) + "|")
    for name, row in table.items():
        print(f"| {name} | " + " | ".join(str(row[f"n = {n}"][column]) for n, column in columns) + " |")


if __name__ == "__main__":
    main()
