"""The policy that a run began with, for comparison with the trained one."""

from __future__ import annotations

import jax
import numpy as np

from jaxpg.program.algorithms import make_algorithm
from jaxpg.program.backend import RUN_ONCE
from jaxpg.program.state import get_policy, make_initial_run
from jaxpg.store.policies import StoredPolicy


def make_untrained(stored: StoredPolicy) -> StoredPolicy:
    """The same agent before its first update."""

    def initial(seed):
        return get_policy(make_initial_run(make_algorithm(stored.config, stored.env), seed).train)

    seed = np.uint32(stored.config.run.seed)
    policy = jax.jit(initial).lower(seed).compile(RUN_ONCE)(seed)
    return stored._replace(policy=jax.tree.map(np.asarray, policy), update=0)
