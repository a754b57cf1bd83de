"""brax's PPO on brax's reacher (spring) or on Playground's CartpoleBalance: `env=NAME steps=... seed=... out=FILE`.

The settings are those that brax's training notebook and Playground publish, but for smaller networks, an eighth of the
environments and smaller batches: theirs are for GPUs, and make a handful of updates in a few million steps. `out` is a
list of {"steps", "return", "stderr"} of deterministic episodes, as brax's own evaluation plays them.
"""

from __future__ import annotations

from protocol import parse

NAMES = ("env", "steps", "seed", "out")
OPTIONS = parse(NAMES, needed=NAMES)  # before the imports, which take a while

import functools  # noqa: E402
import json  # noqa: E402
import math  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

from brax import envs  # noqa: E402
from brax.training.agents.ppo import networks  # noqa: E402
from brax.training.agents.ppo import train as ppo  # noqa: E402

EPISODES = 128
COMMON = {
    "num_evals": 6,
    "num_eval_envs": EPISODES,
    "deterministic_eval": True,
    "episode_length": 1000,
    "normalize_observations": True,
    "num_envs": 256,
    "num_minibatches": 8,
}
SETTINGS = {
    "reacher": {
        "action_repeat": 4,
        "unroll_length": 50,
        "batch_size": 32,
        "num_updates_per_batch": 8,
        "discounting": 0.95,
        "learning_rate": 3e-4,
        "entropy_cost": 1e-3,
        "reward_scaling": 5,
    },
    "CartpoleBalance": {
        "unroll_length": 30,
        "batch_size": 128,
        "num_updates_per_batch": 16,
        "discounting": 0.995,
        "learning_rate": 1e-3,
        "entropy_cost": 1e-2,
        "reward_scaling": 10,
    },
}


def make(name: str) -> tuple[Any, Any]:
    """The environment, and how it is wrapped for training; None: in brax's way."""
    if name == "reacher":
        return envs.get_environment(name, backend="spring"), None
    from mujoco_playground import registry, wrapper

    return registry.load(name, config_overrides={"impl": "jax"}), wrapper.wrap_for_brax_training


def main(options: dict[str, str]) -> None:
    curve = []

    def note(steps: int, metrics: dict[str, Any]) -> None:
        stderr = float(metrics["eval/episode_reward_std"]) / math.sqrt(EPISODES)
        curve.append({"steps": int(steps), "return": float(metrics["eval/episode_reward"]), "stderr": stderr})
        Path(options["out"]).write_text(json.dumps(curve), encoding="utf-8")

    env, wrap = make(options["env"])
    ppo.train(
        env,
        num_timesteps=int(options["steps"]),
        seed=int(options["seed"]),
        progress_fn=note,
        wrap_env_fn=wrap,
        network_factory=functools.partial(
            networks.make_ppo_networks, policy_hidden_layer_sizes=(64, 64), value_hidden_layer_sizes=(64, 64)
        ),
        **COMMON,
        **SETTINGS[options["env"]],
    )


if __name__ == "__main__":
    main(OPTIONS)
