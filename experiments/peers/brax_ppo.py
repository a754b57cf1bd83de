"""brax's PPO on this repository's pendulum, an MJX model (`physics=scalar`, or `mjx` for vmap(mjx.step)).

`brax.training.agents.ppo.train` needs `jax.device_put_replicated`, which jax 0.10 has no more. It compiles inside its
first epoch and again inside its second; what these take longer than the later ones is in `compile_seconds`.
"""

from __future__ import annotations

from protocol import TORQUE_LIMIT, begin

OPTIONS, RECORDER = begin(["physics"])  # before the imports, which are part of what is timed

import contextlib  # noqa: E402
import functools  # noqa: E402
import itertools  # noqa: E402
import statistics  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import jax  # noqa: E402
from brax.training.agents.ppo import networks  # noqa: E402
from brax.training.agents.ppo import train as ppo  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[2]))  # the repository, whose packages are not installed here
import envs  # noqa: E402

SETTINGS = {
    "num_timesteps": 2_000_000,
    "num_evals": 201,
    "episode_length": 200,
    "num_envs": 256,
    "unroll_length": 10,
    "batch_size": 64,
    "num_minibatches": 4,
    "num_updates_per_batch": 8,
    "discounting": 0.97,
    "gae_lambda": 0.95,
    "learning_rate": 1e-3,
    "entropy_cost": 1e-3,
    "reward_scaling": 0.1,
    "normalize_observations": True,
    "clipping_epsilon": 0.2,
}


COMPILING = 2  # epochs inside which it compiles


class Over(Exception):
    """The time is over: raised out of brax's loop, which has no other way to end early."""


class Look:
    """brax's `policy_params_fn`: called before the first epoch and after each."""

    def __init__(self):
        self.ends: list[float] = []
        self.run = None

    def __call__(self, steps, make_policy, params) -> None:
        if steps == 0:
            policy = functools.partial(make_policy, deterministic=True)
            self.run = jax.jit(lambda params, obs: policy(params)(obs, jax.random.key(0))[0])
        self.ends.append(RECORDER.seconds)
        if len(self.ends) > COMPILING + 1 and RECORDER.due:
            RECORDER.look(steps, lambda obs: TORQUE_LIMIT * self.run(params, obs))
        if RECORDER.over:
            raise Over

    def compile_seconds(self) -> float:
        """Until the end of the epochs that compile, less what they would take otherwise."""
        later = self.ends[COMPILING:]
        epochs = [after - before for before, after in itertools.pairwise(later)]
        return later[0] - COMPILING * (statistics.median(epochs) if epochs else 0.0)


def main() -> None:
    look = Look()
    with contextlib.suppress(Over):
        ppo.train(
            envs.make("pendulum", physics=OPTIONS.get("physics", "scalar")),
            policy_params_fn=look,
            seed=int(OPTIONS.get("seed", "0")),
            network_factory=functools.partial(
                networks.make_ppo_networks, policy_hidden_layer_sizes=(64, 64), value_hidden_layer_sizes=(64, 64)
            ),
            run_evals=False,
            **SETTINGS,
        )
    RECORDER.compile_seconds = look.compile_seconds()
    RECORDER.write()


if __name__ == "__main__":
    main()
