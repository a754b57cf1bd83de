"""Policy gradients for robots as one XLA program.

The equations are pure functions of arrays, to be imported one at a time:

    from jaxpg.returns import lambda_returns
    from jaxpg.distributions import squashed_gaussian_log_prob

`python -m jaxpg.train env=pendulum` trains; `python -m jaxpg.evaluate run=DIR` evaluates; `jaxpg.load(DIR)` is the
policy for a program of one's own.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import jaxlib

from jaxpg.compatibility import check_jaxlib

check_jaxlib(jaxlib.__version__)

__version__ = "0.1.0"

if TYPE_CHECKING:
    from jaxpg.deploy.python_policy import Policy


def load(run: str | os.PathLike[str], checkpoint: str = "best", agent: int | None = None) -> Policy:
    """A policy that was trained: `policy(obs)` is the command in physical units.

        policy = jaxpg.load("runs/pendulum")
        torque = policy([cos_theta, sin_theta, theta_dot])

    Environments of one's own are registered before (docs/own_environment.md).

    Args:
      run: the run folder.
      checkpoint: "best" (by the evaluations while training) or "last".
      agent: which of the run's agents, from 0; None takes the best.

    Raises:
      jaxpg.errors.UserError: no run folder, no checkpoint in it, no such agent, or an unknown environment.
    """
    from jaxpg.deploy import python_policy  # with the environments, slow to import

    return python_policy.load(run, checkpoint, agent)
