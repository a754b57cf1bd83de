"""Stable-Baselines3's PPO on an environment by Gymnasium's name for it, with RL Zoo's settings for Pendulum-v1.

Run as the contestants are (protocol.py), with `env=NAME steps=...`. After each rollout of 4,096 steps the deterministic
policy is shown to the recorder, which plays it in Pendulum-v1.
"""

from __future__ import annotations

from protocol import Recorder, begin

OPTIONS, RECORDER = begin(["env", "steps"], needed=["env", "steps"])

import sys  # noqa: E402
from pathlib import Path  # noqa: E402

import torch  # noqa: E402
from stable_baselines3 import PPO  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402

sys.path.insert(0, str(Path(__file__).parents[2]))  # the repository, if it is not installed

SETTINGS = {
    "n_steps": 1024,
    "gae_lambda": 0.95,
    "gamma": 0.9,
    "n_epochs": 10,
    "ent_coef": 0.0,
    "learning_rate": 1e-3,
    "clip_range": 0.2,
    "use_sde": True,
    "sde_sample_freq": 4,
}


class Look(BaseCallback):
    """Hands the policy to the recorder after every update."""

    def __init__(self, recorder: Recorder):
        super().__init__()
        self.recorder = recorder

    def look(self) -> None:
        self.recorder.look(self.num_timesteps, lambda obs: self.model.predict(obs, deterministic=True)[0])

    def _on_rollout_start(self) -> None:  # the last rollout has been learned from
        self.look()

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.look()


def main() -> None:
    torch.set_num_threads(1)  # with networks this small a second thread only slows it down
    seed = int(OPTIONS.get("seed", "0"))
    pendulums = make_vec_env(OPTIONS["env"], n_envs=4, seed=seed)
    model = PPO("MlpPolicy", pendulums, seed=seed, device="cpu", **SETTINGS)
    RECORDER.ready()
    model.learn(int(OPTIONS["steps"]), callback=Look(RECORDER))


if __name__ == "__main__":
    main()
