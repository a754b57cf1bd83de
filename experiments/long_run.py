"""Claim: models move as in C MuJoCo, for many steps as well as for one, in float64 and in float32.

    python experiments/long_run.py [robots=FOLDER] [FILE ...] [--envs 16] [--steps 50] [--long_steps 100000]
                                   [--systems NAME_OR_FILE ...]

Two tables.

For every model file (by default those of envs/assets; with `robots=FOLDER` all that are in it) the largest difference
from C MuJoCo of positions, and of velocities relative to the largest one, after each of the steps, in float64: a median
and a maximum over the environments, which begin at a keyframe or else the initial position, with random velocities of
0.1 rad/s or m/s and random controls over the whole range of each actuator. Contacts are on, but for those of meshes on
both sides. C MuJoCo's solver ends at the solution. What moves chaotically multiplies rounding errors: "C itself" is
C MuJoCo's own difference after its velocities are changed by 1e-12 of themselves at the beginning.

For some systems, or the named ones and model files, 100,000 steps in float32, in float64 and by C MuJoCo, with the same
controls: mechanical energy at the start, its average over the last tenth and its range, the largest depth of a contact
(below its margin) and the largest excess of a joint's limit, after each tenth step. Trajectories soon differ, as they
are chaotic; these numbers must not.
Also the ratio of our largest depth and excess to C MuJoCo's.

Prints the tables and writes results/long_run.json.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import mujoco
import mujoco.rollout
import numpy as np
from commands import Parser, count, write_json
from measuring import CORES
from robots import list_files, load, make_controls, make_states, name_model

from envs.base import ASSETS
from envs.physics import MujocoModelError, compile_step, describe
from envs.physics.models import find_control_ranges
from jaxpg.commands.ending import run_command
from jaxpg.errors import UserError

QUICK = {"xla_backend_optimization_level": 0}
SAMPLED = 10  # steps between two states that energy and depth are computed of
LONG_ENVS = 4
PARTS = 10  # of a long run, for each of which a number is written down
GYMNASIUM = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"

LINK = '<geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1" contype="0" conaffinity="0"/>'
PENDULUM = f"""<mujoco><option timestep=".002" integrator="{{}}"/><worldbody><body pos="0 0 2">
<joint name="a" axis="0 1 0"/>{LINK}<body pos="0 0 -.5"><joint axis="0 1 0"/>{LINK}</body></body></worldbody>
<keyframe><key qpos="1.5 .5"/></keyframe></mujoco>"""
BOX = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/>
<body pos="0 0 .5" euler="20 30 0"><freejoint/><geom type="box" size=".1 .15 .2"/></body></worldbody></mujoco>"""
# A model's text or file for each system; limits and contacts are those of the model.
SYSTEMS = {
    "double pendulum, Euler": PENDULUM.format("Euler"),
    "double pendulum, RK4": PENDULUM.format("RK4"),
    "box on a plane": BOX,
    "Panda at its limits": ASSETS / "panda.xml",
    "hopper": GYMNASIUM / "hopper.xml",
    "ant": GYMNASIUM / "ant.xml",
}


def converge(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model with the settings at which C MuJoCo's solver finds the minimum."""
    model = copy.copy(model)
    model.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
    model.opt.tolerance, model.opt.iterations = 0, 300
    model.opt.ls_tolerance, model.opt.ls_iterations = 1e-12, 100
    return model


@contextlib.contextmanager
def precision(name: str) -> Iterator[None]:
    with jax.enable_x64(name == "float64"):
        yield


def list_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """The parts of a state."""
    return ("qpos", "qvel", "act") if model.na else ("qpos", "qvel")


def play(model: mujoco.MjModel, states: dict, controls: np.ndarray, every: int, options: dict | None = None) -> list:
    """Our states `[N, T / every, size]` after each `every` steps, with controls `[N, T, nu]`."""
    names = list_names(model)
    step = jax.vmap(compile_step(model, inputs=(*names, "ctrl"), outputs=names))

    def advance(state, controls):
        return jax.lax.scan(lambda s, ctrl: (step(*s, ctrl), None), state, controls)[0]

    def simulate(state, controls):
        return jax.lax.scan(lambda s, c: (advance(s, c),) * 2, state, controls)[1]

    parts = np.moveaxis(controls, 1, 0).reshape(controls.shape[1] // every, every, len(controls), model.nu)
    arguments = tuple(jnp.asarray(states[name], float) for name in names), jnp.asarray(parts, float)
    found = jax.jit(simulate).lower(*arguments).compile(options)(*arguments)
    return [np.moveaxis(np.asarray(x), 0, 1) for x in found]


def play_in_c(model: mujoco.MjModel, states: dict, controls: np.ndarray, every: int) -> list:
    """The same by C MuJoCo."""
    datas = [mujoco.MjData(model) for _ in range(CORES)]
    initial = np.concatenate([np.zeros((len(controls), 1)), states["qpos"], states["qvel"], states["act"]], 1)
    found = mujoco.rollout.rollout(model, datas, initial, controls)[0][:, every - 1 :: every, 1:]
    return np.split(found, [model.nq, model.nq + model.nv], -1)[: len(list_names(model))]


# --- every model, some steps ------------------------------------------------------------------------------------------


def compare(ours: list, true: list) -> dict[str, Any]:
    """Largest differences of positions, and of velocities relative to the largest: (median, maximum)."""
    (qpos, qvel), (true_qpos, true_qvel) = ours[:2], true[:2]
    speed = np.maximum(1, np.abs(true_qvel).max((1, 2)))
    errors = np.abs(qpos - true_qpos).max((1, 2)), np.abs(qvel - true_qvel).max((1, 2)) / speed
    return {
        name: [float(np.median(x)), float(x.max())] for name, x in zip(("position", "velocity"), errors, strict=True)
    }


def compare_model(path: Path, options) -> dict[str, Any]:
    """The differences of one model file; of one that cannot be stepped, what MuJoCo or we say of it."""
    name = name_model(path)
    try:
        model = converge(load(path))
    except MujocoModelError as error:
        return {"model": name, "error": str(error)}
    states = make_states(model, options.envs)
    controls = np.repeat(make_controls(model, options.envs, 1.0)[:, None], options.steps, 1)
    true = play_in_c(model, states, controls, 1)
    moved = {**states, "qvel": states["qvel"] * (1 + 1e-12)}
    with precision("float64"):
        ours = play(model, states, controls, 1, QUICK)
        reason = describe(model, inputs=(*list_names(model), "ctrl")).reason
    return {
        "model": name,
        "reason": reason,
        "ours": compare(ours, true),
        "C itself": compare(play_in_c(model, moved, controls, 1), true),
    }


def show_model(row: dict[str, Any]) -> None:
    if "error" in row:
        print(f"{row['model']:34} {row['error'][:160]}", flush=True)
        return
    numbers = [*row["ours"]["position"], *row["ours"]["velocity"], *row["C itself"]["position"]]
    by = f"  stepped by C MuJoCo: {row['reason'][:60]}" if row["reason"] else ""
    print(f"{row['model']:34} " + " ".join(f"{number:8.1e}" for number in numbers) + by, flush=True)


# --- some systems, many steps -----------------------------------------------------------------------------------------


def find_systems(given: Sequence[str]) -> dict[str, str | Path]:
    """The systems of the given names and model files."""
    if unknown := [name for name in given if name not in SYSTEMS and not Path(name).is_file()]:
        raise UserError(f"{unknown[0]}: expected a model file or one of {'; '.join(SYSTEMS)}")
    return {name_model(Path(name)) if name not in SYSTEMS else name: SYSTEMS.get(name, Path(name)) for name in given}


def load_system(source: str | Path) -> mujoco.MjModel:
    return load(source) if isinstance(source, Path) else mujoco.MjModel.from_xml_string(source)


def swing(model: mujoco.MjModel, num_envs: int, num_steps: int) -> np.ndarray:
    """Controls that go through the range of each actuator slowly, with other periods for each."""
    periods = np.random.default_rng(2).uniform(500, 3000, (num_envs, 1, model.nu))
    low, high = find_control_ranges(model)
    wave = np.sin(2 * np.pi * np.arange(num_steps)[None, :, None] / periods)
    return (low + high) / 2 + (high - low) / 2 * wave


def measure_states(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Energy [J], largest depth of a contact below its margin [m] and excess of a limit [rad or m]: `[N, T, 3]`."""
    model = copy.copy(model)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    hinges = np.flatnonzero((model.jnt_limited > 0) & (model.jnt_type >= int(mujoco.mjtJoint.mjJNT_SLIDE)))
    (low, high), places = model.jnt_range[hinges].T, model.jnt_qposadr[hinges]
    numbers = np.zeros((*qpos.shape[:2], 3))
    for at in np.ndindex(*qpos.shape[:2]):
        data.qpos, data.qvel = qpos[at], qvel[at]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_energyPos(model, data)
        mujoco.mj_energyVel(model, data)
        joints = data.qpos[places]
        numbers[at] = (
            data.energy.sum(),
            max(data.contact.includemargin - data.contact.dist, default=0.0),
            max([*(low - joints), *(joints - high)], default=0.0),
        )
    return numbers


def summarise(numbers: np.ndarray) -> dict[str, Any]:
    energy, depth, excess = np.moveaxis(numbers, -1, 0)
    parts = np.array_split(np.arange(energy.shape[1]), PARTS)
    return {
        "finite": bool(np.isfinite(numbers).all()),
        "energy_at_start": float(energy[:, 0].mean()),
        "energy": [float(energy[:, part].mean()) for part in parts],
        "energy_range": [float(energy.min()), float(energy.max())],
        "depth": [float(depth[:, part].max()) for part in parts],
        "excess": [float(excess[:, part].max()) for part in parts],
    }


def run_system(name: str, source: str | Path, num_steps: int) -> dict[str, Any]:
    model = load_system(source)
    states, controls = make_states(model, LONG_ENVS), swing(model, LONG_ENVS, num_steps)

    def in_precision(kind: str) -> Callable[[], list]:
        def run():
            with precision(kind):
                return play(model, states, controls, SAMPLED)

        return run

    methods = {kind: in_precision(kind) for kind in ("float32", "float64")}
    methods["C"] = lambda: play_in_c(model, states, controls, SAMPLED)
    found = {kind: summarise(measure_states(model, *run()[:2])) for kind, run in methods.items()}
    return {"system": name, "steps": num_steps, "methods": found}


def show_system(row: dict[str, Any]) -> None:
    in_c = row["methods"]["C"]
    for kind, found in row["methods"].items():
        low, high = found["energy_range"]
        energy = f"{found['energy_at_start']:10.4g} {found['energy'][-1]:10.4g} ({low:.4g} to {high:.4g})"
        largest = [(max(found[key]), max(in_c[key])) for key in ("depth", "excess")]
        numbers = "".join(f"{mine:10.2e}" for mine, _ in largest)
        numbers += "".join(f"{mine / true:7.2f}" if true else "      -" for mine, true in largest)
        print(
            f"{row['system']:24} {kind:8} {energy:46} {numbers}{'' if found['finite'] else ' not finite'}", flush=True
        )


def main(arguments: Sequence[str]) -> None:
    parser = Parser(__doc__)
    parser.add_argument("files", nargs="*", help="model files, and robots=FOLDER")
    parser.add_argument("--envs", type=count, default=16)
    parser.add_argument("--steps", type=count, default=50)
    parser.add_argument("--long_steps", type=count, default=100_000)
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), metavar="NAME_OR_FILE", help="of the long runs")
    options = parser.parse_args(arguments)
    files, long, models, systems = list_files(options.files), find_systems(options.systems), [], []
    print(
        f"model, differences in {options.steps} steps: position (median, maximum), velocity (median, maximum); "
        "C itself: position (median, maximum)"
    )
    for path in files:
        models.append(compare_model(path, options))
        show_model(models[-1])
        write_json("long_run.json", {"models": models, "systems": systems})
    print(
        f"system, {options.long_steps:,} steps, energy at the start, in the end (range) [J], largest depth [m] and "
        "excess of a limit [rad or m], and each of them over C's"
    )
    steps = -(-options.long_steps // (SAMPLED * PARTS)) * SAMPLED * PARTS
    for name, source in long.items():
        systems.append(run_system(name, source, steps))
        show_system(systems[-1])
        write_json("long_run.json", {"models": models, "systems": systems})


if __name__ == "__main__":
    run_command(main)
