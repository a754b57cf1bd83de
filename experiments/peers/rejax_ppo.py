"""rejax's PPO with the settings of its repository's configs/gymnax/pendulum.yaml, one jitted iteration at a time.

That configuration has 150,000 steps; nothing in it depends on their number, so it goes on for as long as it may.
"""

from __future__ import annotations

from protocol import begin

OPTIONS, RECORDER = begin([])  # before the imports, which are part of what is timed

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from rejax import get_algo  # noqa: E402

CONFIG = {
    "env": "Pendulum-v1",
    "agent_kwargs": {"activation": "swish"},
    "num_envs": 100,
    "num_steps": 100,
    "num_epochs": 10,
    "num_minibatches": 10,
    "learning_rate": 0.001,
    "max_grad_norm": 10,
    "gamma": 0.995,
    "gae_lambda": 0.95,
    "clip_eps": 0.2,
    "ent_coef": 0.0,
    "vf_coef": 0.5,
    "normalize_observations": True,
}


def deterministic(algo):
    """`act(state, obs)`: the policy with a standard deviation of nothing, as `act` of its network samples."""

    @jax.jit
    def act(state, obs):
        params = state.actor_ts.params["params"]
        certain = {"params": params | {"action_log_std": jnp.full_like(params["action_log_std"], -30.0)}}
        obs = algo.normalize_obs(state.obs_rms_state, obs)
        return algo.actor.apply(certain, obs, jax.random.key(0), method="act")

    return act


def main() -> None:
    algo = get_algo("ppo").create(**CONFIG)
    state = jax.jit(algo.init_state)(jax.random.PRNGKey(int(OPTIONS.get("seed", "0"))))
    iterate = jax.jit(algo.train_iteration).lower(state).compile()
    act = deterministic(algo)
    RECORDER.ready()
    while not RECORDER.over:
        state = jax.block_until_ready(iterate(state))
        if RECORDER.due:
            RECORDER.look(state.global_step, lambda obs, state=state: act(state, obs))
    RECORDER.look(state.global_step, lambda obs: act(state, obs))


if __name__ == "__main__":
    main()
