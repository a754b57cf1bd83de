"""Claim: a seven-joint arm with its joint limits learns to reach in half a minute on two cores, with compiling.

    python experiments/panda_reach.py [--physics scalar mujoco mjx] [--rounds 5]
    python experiments/panda_reach.py train env=panda_reach            and all other commands of `python -m jaxpg`

The Panda of envs/assets with torque control at 50 Hz, ten physics steps of 2 ms to each, gravity compensated as by the
robot's own controller, joint limits on. The flange shall reach a random point in a box in front of the robot. PPO with
256 environments in two shards, as the second command trains it with.

The first command prints the training's environment steps per second with each kind of physics, all in one process, one
after the other in each round, and writes results/panda_reach.json: medians of the rounds with the smallest and the
largest. With MJX rollouts have 2 steps instead of 50, which changes little, as nearly all time is the physics'.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from commands import Parser, count, write_json
from flax import struct
from measuring import summarise

import envs
from envs.base import ASSETS, Interface, MjxEnv, State, initial_state
from envs.options import option
from envs.physics import PHYSICS, compile_forward, load_spec
from envs.scenes import Scene
from jaxpg import __main__ as jaxpg_main
from jaxpg.commands.ending import run_command
from jaxpg.config.parsing import compose
from jaxpg.program.backend import prepare
from jaxpg.program.compile import compile_program
from jaxpg.program.environment import make_env

REST = np.array([0.0, -0.6, 0.0, -2.2, 0.0, 1.75, 0.785])  # rad
BOX = np.array([0.30, -0.35, 0.15]), np.array([0.65, 0.35, 0.70])  # of goals, m
TORQUES = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # N m
NUM_SUBSTEPS = 10
SHORT = ("num_steps=2",)  # of rollouts with MJX


@dataclass(frozen=True)
class ReachConfig:
    """Options of the task."""

    torque: float = option(0.5, "share of the torque limits", above=0, at_most=1)
    lambda_torque: float = option(1e-5, "weight of the squared torques", at_least=0)
    success_radius: float = option(0.05, "distance that counts as reached [m]", above=0)
    physics: str = option("scalar", "MuJoCo's step as scalar equations, MJX, or C MuJoCo", choices=tuple(PHYSICS))
    episode_length: int = option(100, "steps until the time limit", at_least=1)


TRAINING = {
    "ppo": {
        "num_envs": 256,
        "num_steps": 50,
        "total_steps": 6_000_000,
        "log_interval": 100_000,
        "eval_interval": 1_000_000,
        "algo.epochs": 4,
        "algo.num_shards": 2,
        "algo.minibatches": 8,
        "algo.actor_lr": 0.002,
        "algo.critic_lr": 0.004,
        "algo.final_lr": 0.05,
        "algo.gamma": 0.95,
        "algo.lambda_": 0.9,
        "algo.reward_scale": 5.0,
        "algo.normalize_advantages": False,
        "network.widths": [64, 64],
        "network.activation": "elu",
    }
}


@struct.dataclass
class ReachState:
    """qpos, qvel `[7]`: angles [rad] and velocities [rad/s]; goal `[3]` [m]; where the solver starts, `[7]`."""

    qpos: jax.Array
    qvel: jax.Array
    goal: jax.Array
    qacc_warmstart: jax.Array


class Reach(MjxEnv):
    """r = -d^2 - d - lambda |torque|^2, d the distance of the flange from the goal."""

    def __init__(self, config: ReachConfig = ReachConfig()):
        self.config, self.limits = config, config.torque * TORQUES
        spec = load_spec(ASSETS / "panda.xml")
        spec.option.gravity = [0, 0, 0]  # which is compensated
        state = ("qpos", "qvel", "qacc_warmstart")
        super().__init__(spec, NUM_SUBSTEPS, config.physics, check=False, inputs=(*state, "ctrl"), outputs=state)
        self.place = compile_forward(self.model, inputs=("qpos",), outputs=("site_xpos",))
        self.flange = self.model.site("flange").id

    @property
    def interface(self) -> Interface:
        joints = [f"q{i}" for i in range(1, 8)]
        angles = [f"{function}({name})" for function in ("cos", "sin") for name in joints]
        places = [f"{name} {axis} [m]" for name in ("goal", "error") for axis in "xyz"]
        observations = (*angles, *(f"{name}' [rad/s]" for name in joints), *places)
        return Interface(observations, tuple(f"{name} torque [N m]" for name in joints), tuple(self.limits.tolist()))

    @property
    def scene(self) -> Scene:
        goal = lambda state: state.pipeline_state.goal  # noqa: E731
        return super().scene._replace(goal=goal, goal_radius=self.config.success_radius)

    def find_error(self, state: ReachState) -> jax.Array:
        (places,) = self.place(state.qpos)
        return state.goal - places[self.flange]

    def observe(self, state: ReachState) -> jax.Array:
        parts = jnp.cos(state.qpos), jnp.sin(state.qpos), state.qvel, state.goal, self.find_error(state)
        return jnp.concatenate(parts)

    def reset(self, rng: jax.Array) -> State:
        key_angles, key_goal = jax.random.split(rng)
        qpos = REST + jax.random.uniform(key_angles, (7,), minval=-0.2, maxval=0.2)
        goal = jax.random.uniform(key_goal, (3,), minval=BOX[0], maxval=BOX[1])
        state = ReachState(qpos, jnp.zeros(7), goal, jnp.zeros(7))
        return initial_state(state, self.observe(state), metric_names=("distance", "success"))

    def step(self, state: State, action: jax.Array) -> State:
        before = state.pipeline_state
        torque = self.limits * jnp.clip(action, -1.0, 1.0)
        qpos, qvel, qacc = self.physics_step(before.qpos, before.qvel, before.qacc_warmstart, torque)
        after = ReachState(qpos, qvel, before.goal, qacc)
        obs = self.observe(after)
        squared, distance = jnp.sum(self.find_error(before) ** 2), jnp.linalg.norm(obs[-3:])
        reward = -squared - jnp.sqrt(squared + 1e-12) - self.config.lambda_torque * jnp.sum(torque**2)
        success = (distance < self.config.success_radius).astype(reward.dtype)
        metrics = {"distance": distance, "success": success}
        return state.replace(pipeline_state=after, obs=obs, reward=reward, metrics=metrics)


if "panda_reach" not in envs.REGISTRY:
    envs.register("panda_reach", envs.Entry(ReachConfig, Reach, TRAINING))


class Training:
    """Updates of PPO with one kind of physics."""

    def __init__(self, physics: str, sizes: Sequence[str] = ()):
        options = [f"env.physics={physics}", *(SHORT if physics == "mjx" else ()), *sizes]
        config = compose(["env=panda_reach", *options])
        prepare(config)
        began = time.perf_counter()
        self.program = compile_program(config, make_env(config), 1)
        self.state = self.program.init().train
        self.seconds = time.perf_counter() - began
        self.size = config.run.num_envs * config.run.num_steps

    def measure(self) -> float:
        """Environment steps per second of one update."""
        began = time.perf_counter()
        self.state, _ = jax.block_until_ready(self.program.advance(self.state))
        return self.size / (time.perf_counter() - began)


def main(arguments: Sequence[str]) -> Any:
    if arguments and arguments[0] in jaxpg_main.VERBS:
        return jaxpg_main.main(arguments)
    parser = Parser(__doc__)
    parser.add_argument("--physics", nargs="+", choices=PHYSICS, default=["scalar", "mujoco", "mjx"])
    parser.add_argument("--rounds", type=count, default=5)
    options = parser.parse_args(arguments)
    trainings = {physics: Training(physics) for physics in options.physics}
    for training in trainings.values():  # the first update of each, which is slower
        training.measure()
    rates = np.array([[training.measure() for training in trainings.values()] for _ in range(options.rounds)])
    rows = []
    print("physics, s to compile, environment steps/s of training (range)")
    for (physics, training), rate in zip(trainings.items(), rates.T, strict=True):
        low, middle, high = summarise(rate)
        rows.append({"physics": physics, "seconds": training.seconds, "rate": [low, middle, high]})
        print(f"{physics:8} {training.seconds:6.1f} {middle:10,.0f} ({low:,.0f} to {high:,.0f})")
    write_json("panda_reach.json", rows)
    return None


if __name__ == "__main__":
    run_command(main)
