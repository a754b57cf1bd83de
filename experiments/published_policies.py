"""Claim: policies that others trained with MJX earn as much with MuJoCo's scalar equations and with C MuJoCo.

    python experiments/published_policies.py NAME=FILE ... [--envs 64] [--steps 500] [--without mjx]

NAME is an environment of MuJoCo Playground, and FILE a policy for it as ONNX, such as Playground's repository has for
Go1JoystickFlatTerrain and others in mujoco_playground/experimental/sim2sim/onnx. The commands, the noise and the first
states are the environment's own, and the same with each kind of physics:

    scalar    C MuJoCo's step as scalar equations, or C MuJoCo where there are none
    solved    C MuJoCo, whose solver ends at the solution
    mujoco    C MuJoCo, whose solver makes as many iterations as the environment says: one to four
    mjx       what the policy was trained with: MJX, with as many iterations

Prints for each of them the mean return of the first episode, cut after the steps, with its standard error; the share of
environments whose episode ended before; and the difference of returns from those of "solved", by environment (mean and
its standard error). Trajectories separate soon, as steps are chaotic. Writes results/published_policies.json.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import onnx
from commands import Parser, count, write_json
from onnx import numpy_helper

import envs
from envs.playground_env import Playground
from jaxpg.commands.ending import run_command
from jaxpg.errors import UserError

PHYSICS = ("solved", "scalar", "mujoco", "mjx")
OPERATORS: dict[str, Callable] = {
    "Sub": jnp.subtract,
    "Mul": jnp.multiply,
    "Gemm": lambda x, weight, bias: x @ weight + bias,
    "Sigmoid": jax.nn.sigmoid,
    "Tanh": jnp.tanh,
    "Split": lambda x: jnp.split(x, 2, -1),
}
# Attributes with the only values that OPERATORS know.
KNOWN = {"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": 0}


def read_policy(path: Path) -> Callable[[jax.Array], jax.Array]:
    """The function of observations `[N, size]` that an ONNX file states; raises UserError if it has other operators."""
    try:
        graph = onnx.load(path).graph
    except Exception as error:  # of protobuf, which onnx does not name
        raise UserError(f"{path}: cannot be read as an ONNX model ({type(error).__name__})") from error
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    if unknown := sorted({node.op_type for node in graph.node if not is_known(node)}):
        raise UserError(f"{path}: its operators {', '.join(unknown)} are not among {', '.join(OPERATORS)} of an MLP")

    def act(obs):
        values = constants | {graph.input[0].name: obs}
        for node in graph.node:
            found = OPERATORS[node.op_type](*(values[name] for name in node.input))
            values |= zip(node.output, found if len(node.output) > 1 else [found], strict=True)
        return values[graph.output[0].name]

    return act


def is_known(node: onnx.NodeProto) -> bool:
    """Whether `OPERATORS` compute it, with its attributes."""
    attributes = {x.name: onnx.helper.get_attribute_value(x) for x in node.attribute}
    if node.op_type == "Split":  # otherwise along the environments, or in unequal parts
        first, *others = attributes.get("split", (1, 1))
        return attributes.get("axis") == -1 and others == [first]
    return node.op_type in OPERATORS and all(KNOWN.get(name) == value for name, value in attributes.items())


def play(env: Any, act: Callable, num_envs: int, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns of the first episodes, `[N]`, and whether they ended within the steps."""

    def step(carry, _):
        state, going = carry
        state = jax.vmap(env.step)(state, act(state.obs))
        return (state, going * (1 - state.done)), going * state.reward

    @jax.jit
    def run(keys):
        state = jax.vmap(env.reset)(keys)
        (_, going), rewards = jax.lax.scan(step, (state, jnp.ones(num_envs)), length=num_steps)
        return jnp.sum(rewards, 0), going == 0

    returns, ended = run(jax.random.split(jax.random.key(0), num_envs))
    return np.asarray(returns), np.asarray(ended)


def make_env(name: str, physics: str) -> Playground:
    if physics != "solved":
        return envs.make("playground", name=name, physics=physics)
    env = envs.make("playground", name=name, physics="mjx").unwrapped
    options = env.mj_model.opt
    options.iterations, options.ls_iterations, options.tolerance = 100, 50, 1e-12
    return Playground(env, "mujoco")


def find_mean(values: np.ndarray) -> tuple[float, float]:
    """The mean and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / len(values) ** 0.5)


def compare(name: str, path: Path, options) -> dict[str, Any]:
    """What one policy earns with each kind of physics."""
    act, returns, row = read_policy(path), {}, {"environment": name, "policy": path.name, "physics": {}}
    for physics in (kind for kind in PHYSICS if kind not in options.without):
        began = time.perf_counter()
        returns[physics], ended = play(make_env(name, physics), act, *options.sizes)
        row["physics"][physics] = {
            "return": find_mean(returns[physics]),
            "ended": float(ended.mean()),
            "seconds": time.perf_counter() - began,
        }
    for physics, found in row["physics"].items():
        found["difference"] = find_mean(returns[physics] - returns["solved"])
    return row


def show(row: dict[str, Any]) -> None:
    for physics, found in row["physics"].items():
        (mean, error), (difference, of_difference) = found["return"], found["difference"]
        numbers = f"{mean:9.3f} +- {error:.3f}  {100 * found['ended']:5.1f} %  {difference:8.3f} +- {of_difference:.3f}"
        print(f"{row['environment']:36} {physics:7} {numbers}  {found['seconds']:7.1f}", flush=True)


def read_pair(text: str) -> tuple[str, Path]:
    name, equals, path = text.partition("=")
    if not (name and equals and Path(path).is_file()):
        raise UserError(f"{text}: expected NAME=FILE, an environment of Playground and an ONNX file")
    return name, Path(path)


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("policies", nargs="*", metavar="NAME=FILE")
    parser.add_argument("--envs", type=count, default=64)
    parser.add_argument("--steps", type=count, default=500)
    parser.add_argument("--without", nargs="+", choices=PHYSICS[1:], default=[], help="leave out physics")
    options = parser.parse_args(arguments)
    options.sizes = options.envs, options.steps
    if not (pairs := [read_pair(text) for text in options.policies]):
        parser.error("no policy: expected NAME=FILE")
    print("environment, physics, return, episodes that ended before, difference from solved, seconds with compiling")
    rows = []
    for name, path in pairs:
        rows.append(compare(name, path, options))
        show(rows[-1])
        write_json("published_policies.json", {"envs": options.envs, "steps": options.steps, "policies": rows})


if __name__ == "__main__":
    run_command(main)
