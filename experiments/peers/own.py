"""jaxpg: the program of `python -m jaxpg.train env=pendulum algo=... seed=...`, chunk after chunk without a run folder.

What is left out is what no other contestant does either: evaluations on the clock, checkpoints, TensorBoard. The
updates, and so the policies, are those of the command, bit for bit. Options but the recorder's are the command's.
"""

from __future__ import annotations

from protocol import RECORDERS, TORQUE_LIMIT, begin

OPTIONS, RECORDER = begin()  # before the imports, which are part of what is timed

import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import jax  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[2]))  # the repository, if it is not installed
from jaxpg.config.parsing import compose  # noqa: E402
from jaxpg.policy import deterministic_policy  # noqa: E402
from jaxpg.program.backend import prepare  # noqa: E402
from jaxpg.program.compile import compile_program  # noqa: E402
from jaxpg.program.environment import make_env  # noqa: E402
from jaxpg.program.networks import make_networks  # noqa: E402
from jaxpg.program.schedule import plan  # noqa: E402
from jaxpg.program.state import get_policy  # noqa: E402
from jaxpg.store.cache import compilation_cache, physics_cache  # noqa: E402


def main() -> None:
    config = compose(["env=pendulum", *(f"{name}={value}" for name, value in OPTIONS.items() if name not in RECORDERS)])
    prepare(config)
    with physics_cache(config.run.cache):
        env = make_env(config)
    schedule = plan(config)
    with compilation_cache(config.run.cache, print):
        program = compile_program(config, env, schedule.chunk)
    networks = make_networks(config, env)

    @jax.jit
    def run(policy, obs):
        policy = jax.tree.map(lambda x: x[0], policy)  # of the only agent
        return TORQUE_LIMIT * deterministic_policy(networks, policy.params, policy.normalizer)(obs)

    train, update = program.init().train, 0
    RECORDER.ready()
    while update < schedule.num_updates and not RECORDER.over:
        train, _ = program.advance(train, schedule.updates_to_next_line(update))
        update = int(train.update[0])
        if RECORDER.due or update >= schedule.num_updates:
            policy = get_policy(train)
            RECORDER.look(update * schedule.steps_per_update, lambda obs, policy=policy: run(policy, obs))


if __name__ == "__main__":
    main()
