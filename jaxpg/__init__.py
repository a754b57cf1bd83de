"""Policy gradients for robots as one XLA program.

The equations are pure functions of arrays, in modules that are imported at their first use:

    import jaxpg
    jaxpg.returns.lambda_returns(reward, discount, next_value, lambda_=0.95)

`python -m jaxpg.train env=pendulum` trains; `python -m jaxpg.evaluate run=DIR` evaluates; `jaxpg.load(DIR)` is the
policy for a program of one's own.
"""

from __future__ import annotations

import importlib
import os
from types import ModuleType
from typing import TYPE_CHECKING

import jaxlib.version

from jaxpg.compatibility import check_jaxlib

check_jaxlib(jaxlib.version.__version__)

__version__ = "0.1.0"

MATHS = ("returns", "estimators", "baselines", "losses", "distributions", "features", "normalization")
PROGRAMS = ("networks", "vector_env", "policy", "rollout", "methods", "updates", "actor_critic", "ppo", "online")
LIBRARY = (*MATHS, *PROGRAMS, "training", "evaluation")

__all__ = ["__version__", "load", *LIBRARY]  # noqa: PLE0604 # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from jaxpg.deploy.python_policy import Policy


def __getattr__(name: str) -> ModuleType:
    if name in LIBRARY:
        return importlib.import_module(f"jaxpg.{name}")
    raise AttributeError(f"module 'jaxpg' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted({*globals(), *LIBRARY})


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
