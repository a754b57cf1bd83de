"""Stable-Baselines3's PPO and A2C (`algo=ppo`, `algo=a2c`) with RL Zoo's tuned settings for Pendulum-v1."""

from __future__ import annotations

from protocol import Recorder, begin

OPTIONS, RECORDER = begin(["algo"])  # before the imports, which are part of what is timed

import torch  # noqa: E402
from stable_baselines3 import A2C, PPO  # noqa: E402
from stable_baselines3.common.callbacks import BaseCallback  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.vec_env import VecNormalize  # noqa: E402

TOTAL_STEPS = {"ppo": 100_000, "a2c": 1_000_000}


def ppo(seed: int) -> PPO:
    return PPO(
        "MlpPolicy",
        make_vec_env("Pendulum-v1", n_envs=4, seed=seed),
        n_steps=1024,
        gae_lambda=0.95,
        gamma=0.9,
        n_epochs=10,
        ent_coef=0.0,
        learning_rate=1e-3,
        clip_range=0.2,
        use_sde=True,
        sde_sample_freq=4,
        seed=seed,
        device="cpu",
    )


def a2c(seed: int) -> A2C:
    return A2C(
        "MlpPolicy",
        VecNormalize(make_vec_env("Pendulum-v1", n_envs=8, seed=seed), gamma=0.9),
        n_steps=8,
        gae_lambda=0.9,
        gamma=0.9,
        ent_coef=0.0,
        vf_coef=0.4,
        max_grad_norm=0.5,
        learning_rate=lambda left: 7e-4 * left,
        use_rms_prop=True,
        normalize_advantage=False,
        use_sde=True,
        policy_kwargs={"log_std_init": -2, "ortho_init": False},
        seed=seed,
        device="cpu",
    )


class Look(BaseCallback):
    """Hands the policy to the recorder after updates, and ends the training when the time is over."""

    def __init__(self, recorder: Recorder):
        super().__init__()
        self.recorder = recorder

    def act(self, obs):
        vec_env = self.model.get_vec_normalize_env()
        if vec_env is not None:
            obs = vec_env.normalize_obs(obs)
        return self.model.predict(obs, deterministic=True)[0]

    def _on_rollout_start(self) -> None:  # the last rollout has been learned from
        if self.recorder.due:
            self.recorder.look(self.num_timesteps, self.act)

    def _on_step(self) -> bool:
        return not self.recorder.over

    def _on_training_end(self) -> None:
        self.recorder.look(self.num_timesteps, self.act)


def main() -> None:
    torch.set_num_threads(1)  # with networks this small a second thread only slows it down
    name, seed = OPTIONS.get("algo", "ppo"), int(OPTIONS.get("seed", "0"))
    model = {"ppo": ppo, "a2c": a2c}[name](seed)
    RECORDER.ready()
    model.learn(TOTAL_STEPS[name], callback=Look(RECORDER))


if __name__ == "__main__":
    main()
