"""A written controller commands on a microcontroller, under QEMU, what it commands on the host."""

import itertools
import subprocess

import microcontroller
import numpy as np
import pytest
from microcontroller import CONTROLLER, CORES, LEARNER

from envs.base import Interface
from jaxpg.config.parsing import compose
from jaxpg.deploy import c
from jaxpg.deploy.controller import Controller, Layer, Learner
from jaxpg.errors import UserError

try:
    microcontroller.check_tools()
    MISSING = ""
except UserError as error:
    MISSING = str(error)

cross = pytest.mark.skipif(bool(MISSING), reason=MISSING)
OPTIMIZED = ("-O2",)


def drawn(*shape, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(np.float32)


def a_controller(widths, activation="relu", squash=False, learner=None):
    """Of numbers that are drawn; with relu, unsquashed, no function of libm is in it."""
    sizes = [3, *widths, 2]
    layers = [Layer(drawn(n, m, seed=n) / 2, drawn(m, seed=m)) for n, m in itertools.pairwise(sizes)]
    interface = Interface(("a", "b", "c"), ("left", "right"), (20.0, 30.0))
    scale = np.array([1, 2, 0.5], np.float32)
    return Controller("policy", interface, drawn(3), scale, "identity", 1, layers, activation, squash, {}, learner)


def a_learner():
    """Linear, its sigma a parameter."""
    options = compose(("env=pendulum", "algo=online", "algo.actor_lr=1e-3", "algo.critic_lr=1e-3")).algo
    value = Layer(drawn(3, 1), drawn(1, seed=1))
    return a_controller([], squash=True, learner=Learner(value, np.full(2, -0.5, np.float32), options, True))


def tried(core, program, rows, size, folder, options=OPTIMIZED):
    path = microcontroller.image(core, options, folder, program)
    return microcontroller.run(core, path, rows, size)


@cross
@pytest.mark.parametrize("name", CORES)
def test_every_bit_of_a_command_is_the_hosts(name, tmp_path):
    control, obs = a_controller([16, 8]), drawn(50, 3)
    c.write(control, tmp_path)
    host = c.load(control, tmp_path)(obs)
    assert 0.1 < np.mean(np.abs(host) < control.interface.limits) < 1  # some are at a limit
    outcome = tried(CORES[name], CONTROLLER, obs, 2, tmp_path)
    assert microcontroller.other_bits(outcome.numbers, host) == 0
    assert microcontroller.other_bits(-outcome.numbers, host) == host.size
    products = 3 * 16 + 16 * 8 + 8 * 2
    assert (outcome.instructions > 3 * products).all()
    assert (outcome.stack >= 2 * 16 * 4).all()  # what a layer gets and what it gives
    assert (outcome.stack < 1000).all()
    size = microcontroller.sizes(CORES[name], OPTIMIZED, tmp_path, CONTROLLER)["alone"]
    assert size["memory"] == 0 < 4 * products < size["flash"] < 4 * products + 2000


@cross
@pytest.mark.parametrize("name", CORES)
def test_its_tanh_is_newlibs(name, tmp_path):
    """To the last bits, by numpy's arithmetic in double; nothing is computed in double on the way."""
    control, obs = a_controller([8], "tanh", squash=True), drawn(50, 3)
    c.write(control, tmp_path)
    hidden = np.tanh(
        (np.float64(obs) - control.mean) * control.scale @ control.layers[0].weight + control.layers[0].bias
    )
    expected = np.tanh(hidden @ control.layers[1].weight + control.layers[1].bias) * control.interface.limits
    outcome = tried(CORES[name], CONTROLLER, obs, 2, tmp_path)
    np.testing.assert_allclose(outcome.numbers, expected, rtol=0, atol=30 * 1e-6)
    symbols = subprocess.run(["arm-none-eabi-nm", tmp_path / "image.elf"], capture_output=True, text=True, check=True)
    assert " tanhf\n" in symbols.stdout
    assert "__aeabi_d" not in symbols.stdout


@cross
@pytest.mark.parametrize("name", CORES)
def test_every_update_of_a_learner_is_the_hosts(name, tmp_path):
    control = a_learner()
    c.write(control, tmp_path)
    steps = drawn(40, 3 + 2 + 1 + 3 + 2)
    steps[:, -2:] = steps[:, -2:] > 1.5  # ends of both kinds
    assert steps[:, -2:].any(axis=0).all()
    host = c.compile_example(control, tmp_path / "learn.c")(steps)
    assert np.abs(host[-1] - host[0]).max() > 1e-2
    outcome = tried(CORES[name], LEARNER, steps, host.shape[1], tmp_path)
    np.testing.assert_allclose(outcome.numbers, host, rtol=0, atol=2e-6)
    memory = microcontroller.sizes(CORES[name], OPTIMIZED, tmp_path, LEARNER)["alone"]["memory"]
    assert memory == 4 * (2 * host.shape[1] + 1)  # parameters, their traces, gamma^t


@cross
@pytest.mark.parametrize(("name", "options"), microcontroller.BUILDS[:2])
def test_instructions_are_counted(name, options, tmp_path):
    """The same ones again; of a layer that is twice as wide, those of its products more."""
    counts, obs = {}, drawn(5, 3)
    for width in (16, 32, 64):
        c.write(a_controller([width]), tmp_path)
        counts[width] = tried(CORES[name], CONTROLLER, obs, 2, tmp_path, options).instructions
    np.testing.assert_array_equal(counts[64], tried(CORES[name], CONTROLLER, obs, 2, tmp_path, options).instructions)
    np.testing.assert_allclose(counts[64] - counts[32], 2 * (counts[32] - counts[16]), rtol=0.1)
    assert (counts[32] - counts[16] > 16 * (3 + 2)).all()
    assert (counts[64] < 30 * 64 * (3 + 2)).all()


VARIABLES = """
#include "board.h"
static volatile int seven = 7, none;
int main(void) { return !(seven++ == 7 && none++ == 0 && write_calibration(open_file("results", WRITING))); }
"""


@cross
@pytest.mark.parametrize("name", CORES)
def test_variables_have_their_first_values(name, tmp_path):
    (tmp_path / "variables.c").write_text(VARIABLES)
    sources = "start.c", "board.c", str(tmp_path / "variables.c")
    path = microcontroller.linked(CORES[name], OPTIMIZED, tmp_path, "image.elf", *sources)
    assert microcontroller.run(CORES[name], path, drawn(0, 3), 2).numbers.shape == (0, 2)


@cross
def test_a_fault_is_an_error(tmp_path):
    """Here, that of a floating-point instruction on a core without them."""
    c.write(a_controller([4]), tmp_path)
    without = CORES["Cortex-M4F"]._replace(machine=CORES["Cortex-M3"].machine)
    with pytest.raises(RuntimeError, match="the program failed on mps2-an385, status 1"):
        tried(without, CONTROLLER, drawn(5, 3), 2, tmp_path)


@cross
def test_a_call_that_is_too_long_for_the_timer_is_an_error(tmp_path):
    """Some 40,000 products without a floating-point unit."""
    c.write(a_controller([200, 200]), tmp_path)
    with pytest.raises(RuntimeError, match="too long for the timer"):
        tried(CORES["Cortex-M0"], CONTROLLER, drawn(1, 3), 2, tmp_path)


@cross
def test_a_program_that_fails_is_an_error(tmp_path):
    (tmp_path / "fails.c").write_text("int main(void) { return 3; }\n")
    sources = "start.c", "board.c", str(tmp_path / "fails.c")
    path = microcontroller.linked(CORES["Cortex-M0"], OPTIMIZED, tmp_path, "image.elf", *sources)
    with pytest.raises(RuntimeError, match="the program failed on microbit, status 1"):
        microcontroller.run(CORES["Cortex-M0"], path, drawn(0, 3), 2)


def test_ticks_are_instructions():
    """A tick and a half each, and 30 ticks of the measurement itself."""
    count = np.array([0, 2_000, 17_000, 2_000_000])
    np.testing.assert_array_equal(microcontroller._instructions(count * 3 // 2 + 30, 3_030, 3_000_030), count)


def test_a_missing_tool_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match=r"^there is no arm-none-eabi-gcc, no .*, no qemu-system-arm: apt-get .*$"):
        microcontroller.main([])


@cross
@pytest.mark.study
def test_the_experiment(monkeypatch):
    written, full, obs = {}, microcontroller.train, microcontroller.collect_observations
    sizes = (
        "num_envs=2",
        "eval_episodes=2",
        "env.episode_length=10",
        "total_steps=40",
        "algo.actor_lr=1e-4",
        "algo.critic_lr=1e-4",
    )
    monkeypatch.setattr(microcontroller, "train", lambda folder, *options: full(folder, *options, *sizes))
    monkeypatch.setattr(microcontroller, "collect_observations", lambda stored: obs(stored)[::500])
    monkeypatch.setattr(microcontroller, "write_json", lambda name, content: written.update({name: content}))
    monkeypatch.setattr(microcontroller, "BUILDS", microcontroller.BUILDS[:1])
    assert microcontroller.main([]) == 0
    result = written["microcontroller.json"]
    assert result["controller"]["numbers"] == 20
    for name in ("controller", "learner"):
        (build,) = result[name]["builds"].values()
        assert max(build["difference from host"], build["difference from jax"]) < 1e-4
        flash = [size["flash"] for size in build["bytes"].values()]
        assert flash == sorted(flash)
