"""Claim: Gymnasium's robots, written as environments of this library, step many times faster than in EnvPool.

    python experiments/gymnasium_tasks.py [TASK ...] [--envpool PYTHON] [--envs 1024] [--rounds 5]
    python -m venv DIR && DIR/bin/pip install -r experiments/peers/envpool.txt     makes PYTHON, DIR/bin/python

HalfCheetah-v4, Hopper-v4, Walker2d-v4, Ant-v4 and Reacher-v4: Gymnasium's model files, number of physics steps between
two actions, observations, rewards, ends of episodes and initial states. tests/test_gymnasium_tasks.py compares them
with Gymnasium's own. Environment steps per second under random actions, on all cores, with observations, rewards, time
limits and resets:

    ours      compile_step of the model, batched by vmap and divided over CPU devices, one for each core
    EnvPool   1.2.5 in a process of its own, one thread for each core: all environments at once or in two or four
              batches, whichever is fastest

In each round one after the other, so that a ratio compares neighbours in time. Actions are drawn beforehand on both
sides. Ours computes in single precision, EnvPool in double.

Prints one table and writes results/gymnasium_tasks.json: medians of the rounds with the smallest and the largest.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from commands import Parser, count, write_json
from flax import struct
from measuring import CORES, compile_in_parts, count_parts, divide_cpu, summarise, time_calls

from envs.base import MjxEnv, State, initial_state
from envs.options import describe_unknown
from envs.physics import load_spec
from jaxpg.commands.ending import run_command
from jaxpg.errors import UserError
from jaxpg.vector_env import vectorize

ASSETS = Path(find_spec("gymnasium").origin).parent / "envs" / "mujoco" / "assets"
PEER = Path(__file__).parent / "peers" / "envpool_steps.py"
STEPS = 50  # of one call
SECONDS = 2.0  # that one measurement lasts, at least


# --- the environments -------------------------------------------------------------------------------------------------


@struct.dataclass
class TaskState:
    """Positions, velocities, the acceleration from which the solver starts, and where the task's bodies are."""

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    places: jax.Array


class Task(MjxEnv):
    """One of Gymnasium's tasks.

    Like Gymnasium, a task reads the places of bodies as MuJoCo's step leaves them: those of its last evaluation, up to
    a physics step before the state.
    """

    file = ""
    frame_skip = 1  # physics steps between two actions
    bodies: tuple[str, ...] = ()  # whose places are read

    def __init__(self, physics: str = "scalar"):
        state = ("qpos", "qvel", "qacc_warmstart")
        outputs = (*state, "xpos") if self.bodies else state
        spec = load_spec(ASSETS / self.file)
        super().__init__(spec, self.frame_skip, physics, check=False, inputs=(*state, "ctrl"), outputs=outputs)
        self.places = np.array([self.model.body(name).id for name in self.bodies], int)

    def begin(self, qpos: jax.Array, qvel: jax.Array, places: Any = ()) -> State:
        state = TaskState(qpos, qvel, jnp.zeros_like(qvel), jnp.reshape(jnp.asarray(places, qpos.dtype), (-1, 3)))
        return initial_state(state, self.observe(state))

    def advance(self, state: TaskState, action: jax.Array) -> TaskState:
        qpos, qvel, qacc, *xpos = self.physics_step(state.qpos, state.qvel, state.qacc_warmstart, action)
        return TaskState(qpos, qvel, qacc, xpos[0][self.places] if xpos else state.places)

    def observe(self, state: TaskState) -> jax.Array:
        raise NotImplementedError


class Runner(Task):
    """Run forward: r = (x' - x) / dt + alive - cost |a|^2, until the robot is no longer healthy."""

    hidden = 1  # leading positions, which are not observed
    fastest = np.inf  # observed velocities are clipped to it
    alive, cost = 0.0, 0.1
    noise = 0.1  # of initial positions, uniform, and of velocities
    normal = False  # whether the velocities' noise is normal

    def reset(self, rng: jax.Array) -> State:
        key_qpos, key_qvel = jax.random.split(rng)
        qpos = self.model.qpos0 + jax.random.uniform(key_qpos, (self.model.nq,), minval=-self.noise, maxval=self.noise)
        draw = jax.random.normal if self.normal else lambda *args: jax.random.uniform(*args, minval=-1.0)
        return self.begin(qpos, self.noise * draw(key_qvel, (self.model.nv,)), self.find_places(qpos))

    def step(self, state: State, action: jax.Array) -> State:
        before = state.pipeline_state
        after = self.advance(before, action)
        reward = (self.find_x(after) - self.find_x(before)) / self.dt + self.alive - self.cost * jnp.sum(action**2)
        done = 1.0 - self.is_healthy(after).astype(reward.dtype)
        return state.replace(pipeline_state=after, obs=self.observe(after), reward=reward, done=done)

    def observe(self, state: TaskState) -> jax.Array:
        return jnp.concatenate([state.qpos[self.hidden :], jnp.clip(state.qvel, -self.fastest, self.fastest)])

    def find_places(self, qpos: jax.Array) -> Any:
        return ()

    def find_x(self, state: TaskState) -> jax.Array:
        return state.qpos[0]

    def is_healthy(self, state: TaskState) -> jax.Array:
        return jnp.array(True)


class HalfCheetah(Runner):
    file, frame_skip, normal = "half_cheetah.xml", 5, True


class Hopper(Runner):
    file, frame_skip = "hopper.xml", 4
    fastest, alive, cost, noise = 10.0, 1.0, 1e-3, 5e-3

    def is_healthy(self, state: TaskState) -> jax.Array:
        height, angle = state.qpos[1], state.qpos[2]
        others = jnp.concatenate([state.qpos[2:], state.qvel])
        return (height > 0.7) & (jnp.abs(angle) < 0.2) & jnp.all(jnp.abs(others) < 100)


class Walker2d(Hopper):
    file = "walker2d.xml"

    def is_healthy(self, state: TaskState) -> jax.Array:
        height, angle = state.qpos[1], state.qpos[2]
        return (height > 0.8) & (height < 2.0) & (jnp.abs(angle) < 1.0)


class Ant(Runner):
    file, frame_skip, bodies, normal = "ant.xml", 5, ("torso",), True
    hidden, alive, cost = 2, 1.0, 0.5

    def find_places(self, qpos: jax.Array) -> Any:
        return qpos[:3]

    def find_x(self, state: TaskState) -> jax.Array:
        return state.places[0, 0]

    def is_healthy(self, state: TaskState) -> jax.Array:
        finite = jnp.all(jnp.isfinite(state.qpos)) & jnp.all(jnp.isfinite(state.qvel))
        return finite & (state.qpos[2] >= 0.2) & (state.qpos[2] <= 1.0)


class Reacher(Task):
    """Reach a target with a fingertip: r = -|x_tip - x_target| - |a|^2, with the distance before the step."""

    file, frame_skip, bodies = "reacher.xml", 2, ("fingertip", "target")
    radius = 0.2  # of the disk of targets

    def reset(self, rng: jax.Array) -> State:
        key_qpos, key_qvel, key_radius, key_angle = jax.random.split(rng, 4)
        angles = jax.random.uniform(key_qpos, (2,), minval=-0.1, maxval=0.1)
        distance = self.radius * jnp.sqrt(jax.random.uniform(key_radius))
        direction = jax.random.uniform(key_angle, maxval=2 * jnp.pi)
        target = distance * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
        qvel = jnp.pad(jax.random.uniform(key_qvel, (2,), minval=-0.005, maxval=0.005), (0, 2))
        places = jnp.stack([find_fingertip(angles), target])
        return self.begin(
            jnp.concatenate([angles, target]), qvel, jnp.pad(places, ((0, 0), (0, 1)), constant_values=0.01)
        )

    def step(self, state: State, action: jax.Array) -> State:
        before = state.pipeline_state
        after = self.advance(before, action)
        reward = -jnp.linalg.norm(before.places[0] - before.places[1]) - jnp.sum(action**2)
        return state.replace(pipeline_state=after, obs=self.observe(after), reward=reward)

    def observe(self, state: TaskState) -> jax.Array:
        angles = state.qpos[:2]
        error = state.places[0] - state.places[1]
        return jnp.concatenate([jnp.cos(angles), jnp.sin(angles), state.qpos[2:], state.qvel[:2], error])


def find_fingertip(angles: jax.Array) -> jax.Array:
    """Its place in the plane: links of 0.1 m and 0.11 m at the angles q_1 and q_1 + q_2."""
    directions = jnp.cumsum(angles)
    return jnp.stack([jnp.cos(directions), jnp.sin(directions)]) @ jnp.array([0.1, 0.11])


TASKS = {
    "HalfCheetah-v4": HalfCheetah,
    "Hopper-v4": Hopper,
    "Walker2d-v4": Walker2d,
    "Ant-v4": Ant,
    "Reacher-v4": Reacher,
}
LENGTHS = {"Reacher-v4": 50}  # of episodes; the others have 1,000 steps


# --- what is measured -------------------------------------------------------------------------------------------------


class Ours:
    """All environments of a task on all cores; each call of `play` goes on where the last one ended."""

    def __init__(self, name: str, num_envs: int):
        number = count_parts(num_envs)
        vector = vectorize(TASKS[name](), num_envs // number, LENGTHS.get(name, 1000))

        def reset(keys):
            return vector.reset(keys[0])

        def play(actions, state, keys):
            def step(state, drawn):
                action, key = drawn
                state, outcome = vector.step(state, action, key)
                return state, jnp.mean(outcome.reward)

            given = actions[:, : num_envs // number], jax.random.split(keys[0], STEPS)
            state, rewards = jax.lax.scan(step, state, given)
            return state, jnp.broadcast_to(jnp.mean(rewards), keys.shape)

        size = (STEPS, num_envs, vector.action_size)
        self.size, self.keys = num_envs * STEPS, jax.random.split(jax.random.key(0), num_envs)
        self.actions = jax.random.uniform(jax.random.key(1), size, minval=-1.0)
        self.state = compile_in_parts(reset, number)(self.keys)
        began = time.perf_counter()
        divided = compile_in_parts(play, number, (None, 0, 0))
        self.run = divided.lower(self.actions, self.state, self.keys).compile()
        self.seconds = time.perf_counter() - began

    def play(self) -> float:
        """The mean reward of a step."""
        self.keys = jax.vmap(lambda key: jax.random.fold_in(key, 1))(self.keys)
        self.state, reward = self.run(self.actions, self.state, self.keys)
        return float(jnp.mean(reward))

    def measure(self) -> float:
        """Environment steps per second."""
        return self.size * time_calls(self.play, SECONDS)[0]


class InEnvPool:
    """The same in EnvPool, by the script peers/envpool_steps.py."""

    def __init__(self, interpreter: str, name: str, num_envs: int):
        options = (f"task={name}", f"envs={num_envs}", f"threads={CORES}", f"seconds={SECONDS / 3}")
        command = [interpreter, PEER, *options]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def measure(self) -> float:
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        line = self.process.stdout.readline()
        if not line:
            raise UserError("EnvPool's process has ended")
        return max(json.loads(line).values())

    def close(self) -> None:
        with self.process as process:  # which closes its files, and waits for it
            process.stdin.close()


def measure_task(name: str, options) -> dict[str, Any]:
    ours = Ours(name, options.envs)
    methods: dict[str, Any] = {"ours": ours}
    if options.envpool:
        methods["EnvPool"] = InEnvPool(options.envpool, name, options.envs)
    for method in methods.values():  # the first call of each, which is slower
        method.measure()
    rates = np.array([[method.measure() for method in methods.values()] for _ in range(options.rounds)])
    row = {"task": name, "seconds": ours.seconds, "reward": ours.play()}
    row |= {key: summarise(rates[:, i]) for i, key in enumerate(methods)}
    if options.envpool:
        methods["EnvPool"].close()
        row["ratio"] = summarise(rates[:, 0] / rates[:, 1])
    return row


def show(row: dict[str, Any]) -> None:
    print(f"{row['task']:15} {row['seconds']:6.1f} {row['reward']:7.3f} {row['ours'][1]:12,.0f}", end="")
    if "ratio" in row:
        low, middle, high = row["ratio"]
        print(f" {row['EnvPool'][1]:10,.0f}  {middle:6.1f} ({low:.1f} to {high:.1f})", end="")
    print(flush=True)


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=", ".join(TASKS))
    parser.add_argument("--envpool", metavar="PYTHON", help="interpreter that has EnvPool; without it, ours alone")
    parser.add_argument("--envs", type=count, default=1024)
    parser.add_argument("--rounds", type=count, default=5)
    options = parser.parse_args(arguments)
    tasks = options.tasks or list(TASKS)
    for name in tasks:
        if name not in TASKS:
            parser.error(describe_unknown("task", name, TASKS))
    divide_cpu()
    print("task, s to compile, mean reward, environment steps/s: ours, EnvPool; ours over EnvPool (range)")
    rows = []
    for name in tasks:
        rows.append(measure_task(name, options))
        show(rows[-1])
        write_json("gymnasium_tasks.json", rows)


if __name__ == "__main__":
    run_command(main)
