"""RLtools' SAC (C++, compiled when it is imported) on Gymnasium's Pendulum-v1: the example of its Python package.

Its default settings, with one update after each step, for five times its default number of steps; actions are scaled to
[-1, 1].
"""

from __future__ import annotations

from protocol import TORQUE_LIMIT, begin

OPTIONS, RECORDER = begin([])  # before the imports, which are part of what is timed

import gymnasium  # noqa: E402
import numpy as np  # noqa: E402
from gymnasium.wrappers import RescaleAction  # noqa: E402
from rltools import SAC  # noqa: E402

STEP_LIMIT = 50_000


def main() -> None:
    seed = int(OPTIONS.get("seed", "0"))

    def make_env():
        env = RescaleAction(gymnasium.make("Pendulum-v1"), -1, 1)
        env.reset(seed=seed)
        return env

    sac = SAC(
        make_env, interface_name="time_to_solve", STEP_LIMIT=STEP_LIMIT, enable_evaluation=False, force_recompile=True
    )
    state = sac.State(seed)

    def act(obs):
        return TORQUE_LIMIT * np.stack([state.action(row) for row in obs])

    RECORDER.ready()
    steps, finished = 0, False
    while not finished and not RECORDER.over:
        finished = state.step()
        steps += not finished
        if RECORDER.due:
            RECORDER.look(steps, act)
    RECORDER.look(steps, act)


if __name__ == "__main__":
    main()
