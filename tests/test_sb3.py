"""Stable-Baselines3 on the environments; needs `pip install stable-baselines3`, and is left out without it."""

import re
import warnings
from pathlib import Path

import gymnasium
import pytest

pytest.importorskip("stable_baselines3")

import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

import jaxpg.gymnasium  # noqa: F401, registers the names


@pytest.mark.parametrize("name", ["jaxpg/Pendulum-v0", "jaxpg/Arm-v0"])
def test_the_checker_has_nothing_to_say(name):
    """But that it would rather have actions in [-1, 1]."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        check_env(gymnasium.make(name))
    assert [str(warning.message) for warning in said if "normalized" not in str(warning.message)] == []


def test_ppo_trains():
    """20,000 steps in four environments made by their name, with RL Zoo's settings for Pendulum-v1, earn 400 more."""
    torch.set_num_threads(1)  # with networks this small a second thread only slows it down
    pendulums = make_vec_env("jaxpg.gymnasium:jaxpg/Pendulum-v0", n_envs=4, seed=0)
    settings = {"n_steps": 1024, "gamma": 0.9, "learning_rate": 1e-3, "use_sde": True, "sde_sample_freq": 4}
    model = PPO("MlpPolicy", pendulums, seed=0, device="cpu", **settings)
    before, _ = evaluate_policy(model, pendulums, n_eval_episodes=20)
    model.learn(20_000)
    after, _ = evaluate_policy(model, pendulums, n_eval_episodes=20)
    print(before, after)
    assert after > before + 400


def test_the_pages_example_runs():
    """With a single rollout."""
    page = (Path(__file__).parent.parent / "docs" / "plugging_in.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```py\n(from stable_baselines3.*?)```", page, re.DOTALL)
    assert "60_000" in code
    exec(code.replace("60_000", "1"), {})
