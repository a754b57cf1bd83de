"""What the page of a run is given, made up by closed forms: pendulum, arm, a robot in space, comparison."""

import base64
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from envs.scenes import Scene
from jaxpg.watch import stage_in_space
from jaxpg.watch.clips import Clip
from jaxpg.watch.recording import Look

Json = dict[str, Any]
INT16 = 2**15 - 1
DT = 0.05
ROD = 1.0
LINKS = (0.5, 0.5)
# What must stay text wherever it stands.
NASTY = "</script><script>alert(1)</script><!-- <img src=x onerror=alert(2)> &amp; \u2028 \ud800 'a' $data ${style}"


def packed(values: np.ndarray) -> str:
    """Numbers within +-32767 as base64 of little-endian int16."""
    return base64.b64encode(np.rint(values).astype("<i2").tobytes()).decode("ascii")


def panel(title: str, *series: Json, references: Any = ()) -> Json:
    return {"title": title, "x": "environment steps", "references": list(references), "series": list(series)}


def curve(label: str, final: float, rate: float, width: float | None = 4.0, number: int = 25) -> Json:
    """A return that rises from -1200 as an exponential; `width` of its interval at the end, None without one."""
    steps = np.linspace(0, 960_000, number)
    mean = final - (1200 + final) * np.exp(-rate * steps / 1e5)
    spread = None if width is None else width * (1 + 20 * np.exp(-rate * steps / 1e5))
    low, high = (None, None) if spread is None else ((mean - spread).tolist(), (mean + spread).tolist())
    band = None if spread is None else "16 seeds, 95 % interval"
    return {"label": label, "steps": steps.tolist(), "mean": mean.tolist(), "low": low, "high": high, "band": band}


def document(kind: str, title: str, **parts: Any) -> Json:
    """Everything that a page is given; parts that are not named are not there."""
    absent: Json = dict.fromkeys(("head", "player", "portrait", "workspace", "improvement", "command"))
    lists: Json = {"facts": [], "notes": [], "curves": [], "diagnostics": [], "tables": []}
    lists |= {"configuration": [], "versions": []}
    return {"kind": kind, "title": title} | lists | absent | parts


def episode(parts: np.ndarray, motors: np.ndarray, goal: Any, series: dict[str, np.ndarray], **more: Any) -> Json:
    """An EPISODE of places and turned axes of parts `[F, P, 8]`, and of places of motors `[F, M, 2]`."""
    scale = max(np.abs(parts).max(), np.abs(motors).max()) / INT16
    return {
        "return": float(np.sum(series["reward"])),
        "success": None,
        "frames": len(parts),
        "scale": float(scale),
        "parts": packed(parts / scale),
        "motors": packed(motors / scale),
        "goal": goal,
        "series": {name: values.tolist() for name, values in series.items()},
        "path": None,
    } | more


def along(length: float) -> list[list[float]]:
    """The ends of a rod that lies along the x axis of its frame."""
    return [[0.0, 0.0, 0.0], [length, 0.0, 0.0]]


def rod(x: Any, y: Any, angle: np.ndarray) -> np.ndarray:
    """A frame at x, y whose x axis is turned by the angle in the plane: `[F, 8]`."""
    zero, cos, sin = 0 * angle, np.cos(angle), np.sin(angle)
    return np.stack([x + zero, y + zero, cos, -sin, zero, sin, cos, zero], axis=-1)


def policies(play: Callable[[int, int], Json], episodes: int = 3) -> list[Json]:
    """`play(policy, episode)` before and after training."""
    labels = [("before training", "0 updates"), ("best", "120 updates")]
    return [
        {"label": label, "note": note, "episodes": [play(i, k) for k in range(episodes)]}
        for i, (label, note) in enumerate(labels)
    ]


def wrapped(angle: np.ndarray) -> np.ndarray:
    """In [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def swing(policy: int, number: int) -> Json:
    """Before training it turns over and over; afterwards it settles upright, at 0, as a damped oscillator."""
    time, start = np.arange(0, 101 + 10 * number) * DT, 2.6 - 0.5 * number
    if policy == 0:
        angle, speed = start + 3 * time, np.full_like(time, 3.0)
    else:
        angle = start * np.exp(-time) * np.cos(3 * time)
        speed = -start * np.exp(-time) * (np.cos(3 * time) + 3 * np.sin(3 * time))
    torque = (0.2 if policy == 0 else 2.0) * np.cos(3 * time[:-1]) * np.exp(-time[:-1] / 2)
    reward = -(wrapped(angle[:-1]) ** 2) - 0.1 * speed[:-1] ** 2 - 0.001 * torque**2
    parts = rod(0, 0, angle + np.pi / 2)[:, None]
    series = {"torque [N m]": torque, "reward": reward, "value": -20 * np.exp(-time[:-1]) * policy}
    return episode(parts, np.zeros((len(time), 1, 2)), None, series, path=[wrapped(angle).tolist(), speed.tolist()])


def value_grid(scale: float) -> Json:
    """A well along the line on which the pendulum comes to rest."""
    angle, speed = np.meshgrid(np.linspace(-np.pi, np.pi, 41), np.linspace(-8, 8, 41))
    values = -scale * (angle**2 + 0.4 * angle * speed + 0.1 * speed**2) + 0.02 * scale
    low, high = values.min(), values.max()
    return {"low": float(low), "high": float(high), "data": packed((values - low) / (high - low) * INT16)}


def pendulum(**changes: Any) -> Json:
    """The run of a pendulum: player, phase portrait, one panel of curves."""
    player = {
        "dt": DT,
        "view": [-1.25, -1.25, 1.25, 1.25],
        "parts": [{"points": along(ROD), "radius": 0.05, "color": "#cc4d4d"}],
        "motors": [{"name": "torque [N m]", "limit": 2.0, "sign": 1}],
        "limits": {"torque [N m]": 2.0},
        "goal_radius": None,
        "series": ["torque [N m]", "reward", "value"],
        "policies": policies(swing),
    }
    portrait = {
        "title": "value and phase portrait",
        "x": {"label": "theta [rad]", "range": [-np.pi, np.pi], "wraps": True},
        "y": {"label": "theta' [rad/s]", "range": [-8.0, 8.0], "wraps": False},
        **{"columns": 41, "rows": 41, "values": [value_grid(0.5), value_grid(8.0)]},
    }
    parts = {
        "facts": [["return", "-147.2 at the end, -147.1 at best"], ["steps", "1,000,000"]],
        "head": {
            "title": "policies",
            "columns": ["policy", "return", "chatter"],
            "rows": [["before training", "-1170.0 ± 23.8", "0.4 %"], ["best", "-147.2 ± 2.1", "13.0 %"]],
            "note": "mean and standard error",
        },
        "curves": [
            panel(
                "return",
                *(curve("deterministic policy", -147.0, 1.2), curve("while training", -160.0, 0.8, None)),
                references=[{"label": "best possible", "value": -137.4}, {"label": "far away", "value": -1e5}],
            )
        ],
        "diagnostics": [panel("KL divergence of an update", curve("while training", 0.01, 1.0, None))],
        "command": "python -m jaxpg.train env=pendulum env.mass=2.0",
        "player": player,
        "portrait": portrait,
        "configuration": [["env", "pendulum", None], ["env.mass", "2.0", "1.0"], ["algo.gamma", "0.97", None]],
        "versions": [["jax", "0.10.1"], ["mujoco", "3.17.0"]],
    }
    return document("run", "ppo on pendulum, seed 0", **parts | changes)


def tip(upper: float, fore: float) -> list[float]:
    """Where links at these angles end."""
    end = LINKS[0] * np.exp(1j * upper) + LINKS[1] * np.exp(1j * fore)
    return [float(end.real), float(end.imag)]


GOALS = [tip(0.6 + 1.9 * number, 1.7 + 1.9 * number) for number in range(3)]


def reach(policy: int, number: int) -> Json:
    """Before training it hardly moves; afterwards its joints go to their goal as exponentials."""
    time = np.arange(101) * DT
    goal_angles, goal = np.array([0.6 + 1.9 * number, 1.1]), complex(*GOALS[number])
    share = (1 - np.exp(-2 * time)) * (1.0 if policy else 0.1)
    upper, fore = share * goal_angles[0], share * goal_angles.sum()
    elbow = LINKS[0] * np.stack([np.cos(upper), np.sin(upper)], axis=-1)
    tip = elbow + LINKS[1] * np.stack([np.cos(fore), np.sin(fore)], axis=-1)
    distance = np.hypot(tip[:, 0] - goal.real, tip[:, 1] - goal.imag)
    parts = np.stack([rod(0, 0, upper), rod(*elbow.T, fore)], axis=1)
    torques = {f"{name} torque [N m]": 2 * size * np.exp(-2 * time[:-1]) for name, size in JOINTS.items()}
    series = torques | {"reward": -distance[:-1], "value": -5 * distance[:-1]}
    motors = np.stack([0 * elbow, elbow], axis=1)
    return episode(parts, motors, [goal.real, goal.imag], series, success=bool(distance[-1] < 0.05))


JOINTS = {"shoulder": 0.9, "elbow": -0.5}


def arm(**changes: Any) -> Json:
    """The run of an arm: player with a goal, workspace, two panels of curves."""
    angle, radius = 2.4 * np.arange(120), 0.2 + 0.75 * np.sqrt(np.arange(120) / 120)
    goals = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    number = np.arange(120)
    reached = (number % 40 == 7, number % 40 != 7)  # 3 before training, 117 afterwards
    points = [np.column_stack([goals, np.where(x, 0.01, 0.3), x]).tolist() for x in reached]
    player = {
        "dt": DT,
        "view": [-1.1, -1.1, 1.1, 1.1],
        "parts": [
            {"points": along(length), "radius": radius, "color": color}
            for length, radius, color in zip(LINKS, (0.03, 0.025), ("#4d66cc", "#4d99e6"), strict=True)
        ],
        "motors": [{"name": f"{name} torque [N m]", "limit": 2.0, "sign": 1} for name in JOINTS],
        "limits": {f"{name} torque [N m]": 2.0 for name in JOINTS},
        "goal_radius": 0.05,
        "series": [*(f"{name} torque [N m]" for name in JOINTS), "reward", "value"],
        "policies": policies(reach),
    }
    parts = {
        "facts": [["return", "-11.8 at the end"], ["steps", "1,000,000"]],
        "curves": [panel("return", curve("deterministic policy", -12.0, 1.0))],
        "player": player,
        "workspace": {
            "title": "success over the workspace",
            "success_radius": 0.05,
            "pictures": [
                {
                    **{"x": "x [m]", "y": "y [m]", "x_range": [-1.0, 1.0], "y_range": [-1.0, 1.0]},
                    **{"circle": [0.0, 0.0, 0.95], "points": points, "chosen": [GOALS, GOALS]},
                }
            ],
        },
        "configuration": [["env", "arm"]],
        "versions": [["jax", "0.10.1"]],
    }
    return document("run", "ppo on arm, seed 0", **parts | changes)


TURNER = """<mujoco><worldbody>
  <body pos="0 0 .1"><joint axis="0 0 1"/><geom type="box" size=".1 .1 .1" rgba=".8 .2 .2 1"/>
    <body pos="0 0 .1"><joint axis="0 1 0"/><geom type="box" size=".04 .04 .3" pos="0 0 .3" rgba=".2 .3 .8 1"/>
      <site name="tip" pos="0 0 .6"/></body></body>
</worldbody></mujoco>"""
GOAL_RADIUS = 0.05


def turn(policy: int, number: int) -> Clip:
    """Turns the column and leans the beam; before training half as fast. The goal is at the beam's end, and turned."""
    time, model = np.arange(61) * DT, mujoco.MjModel.from_xml_string(TURNER)
    speed = np.array([0.5 + 0.3 * number, 0.4]) * (1.0 if policy else 0.5)
    data = mujoco.MjData(model)
    data.qpos = 3.0 * np.array([0.5 + 0.3 * number, 0.4])
    mujoco.mj_kinematics(model, data)
    goal, rotation = (np.tile(x[0], (61, 1)) for x in (data.site_xpos, data.site_xmat))
    look = Look(time[:, None] * speed, goal, None, rotation.reshape(-1, 3, 3))
    series = {"u [rad/s]": np.full(60, speed[0]), "reward": -np.ones(60), "value": -np.ones(60)}
    return Clip(look, series, -np.arange(61.0), DT, -60.0, bool(policy))


def turner(**changes: Any) -> Json:
    """The run of a robot in space: a column that turns, with a beam on it that leans; its goal is a pose."""
    scene = Scene(mujoco.MjModel.from_xml_string(TURNER), None, goal_radius=GOAL_RADIUS, site=0)
    clips = [[turn(policy, number) for number in range(3)] for policy in range(2)]
    common, drawn = stage_in_space.make_stage(scene, clips)

    def play(policy: int, number: int) -> Json:
        clip = clips[policy][number]
        series = {name: values.tolist() for name, values in clip.series.items()}
        known = {"return": clip.episode_return, "success": clip.success, "so_far": clip.so_far.tolist()}
        return known | {"series": series, "path": None} | drawn[policy][number]

    rim = [[0.5 * np.cos(a), 0.5 * np.sin(a), a / 7, 0.01 + 0.05 * (i % 2), 1 - i % 2] for i, a in enumerate(range(20))]
    above = {"x": "x [m]", "y": "y [m]", "x_range": [-0.6, 0.6], "y_range": [-0.6, 0.6], "circle": [0.0, 0.0, 0.5]}
    side = {"x": "r [m]", "y": "z [m]", "x_range": [0.0, 0.6], "y_range": [0.0, 3.0], "circle": None}
    points = [[[x, y, d, s] for x, y, _, d, s in rim]] * 2, [[[0.5, z, d, s] for _, _, z, d, s in rim]] * 2
    pictures = [
        one | {"points": rows, "chosen": [[rows[0][i][:2] for i in range(3)]] * 2}
        for one, rows in zip((above, side), points, strict=True)
    ]
    parts = {
        "curves": [panel("return", curve("deterministic policy", -12.0, 1.0))],
        "player": {
            **{"dt": DT, "limits": {"u [rad/s]": 2.0}, "goal_radius": GOAL_RADIUS},
            **{"series": ["u [rad/s]", "reward", "value"], "policies": policies(play), **common},
        },
        "workspace": {"title": "success over the workspace", "success_radius": GOAL_RADIUS, "pictures": pictures},
    }
    return document("run", "ppo on turner, seed 0", **parts | changes)


def comparison(**changes: Any) -> Json:
    """Three runs side by side: two panels of curves, a table, probabilities of improvement."""
    labels = ["ppo", "td, lambda 0.95", "reinforce"]
    returns = [curve(label, -147.0 - 20 * i, 1.2 / (1 + i), 4.0 + 5 * i) for i, label in enumerate(labels)]
    rewards = [curve(label, -1.0 - i, 1.2, None) for i, label in enumerate(labels[:2])]
    parts = {
        "facts": [["runs", "3"], ["seeds", "16 of each"]],
        "curves": [panel("return", *returns), panel("reward", *rewards)],
        "tables": [
            {
                "title": "Runs, the best first",
                "columns": ["run", "return at the end", "seeds"],
                "rows": [
                    [label, f"-{147 + 20 * i}.1 [-{152 + 20 * i}.0, -{143 + 20 * i}.2]", "16"]
                    for i, label in enumerate(labels)
                ],
                "note": None,
            }
        ],
        "improvement": {
            "labels": labels,
            "probability": [[None, 0.81, 0.99], [0.19, None, 0.58], [0.01, 0.42, None]],
            "low": [[None, 0.7, 0.97], [0.08, None, 0.4], [0.0, 0.24, None]],
            "high": [[None, 0.92, 1.0], [0.3, None, 0.76], [0.03, 0.6, None]],
        },
    }
    return document("comparison", "3 runs on pendulum", **parts | changes)
