"""Claim: an exported controller runs on a microcontroller, and commands there what it commands on the host.

    python experiments/microcontroller.py

Trains the pendulum by its default command, and once more step by step (`algo=online`), and exports both. The headers
are compiled for three cores, with the start-up code and the programs of experiments/microcontroller, and run by QEMU:

- 10,000 observations go in and 10,000 commands come back, as the bytes of their floats: the largest difference from
  the same header compiled for the host, how many have other bits, and the largest difference from JAX;
- 1,000 updates of the learner: the same of all parameters after each update;
- bytes of flash and of memory: of the object with the controller alone, of it with what it calls of libm and libgcc
  (newlib's errno included), of the whole program; and of the stack, painted before each call and looked at after it;
- instructions of one command or update. QEMU counts instructions, and knows nothing of cycles, of the waits of a real
  flash, or of how long a division takes: the microseconds are estimates, at one instruction a cycle.

Writes results/microcontroller.json.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from commands import Parser, largest_difference, train, write_json

from jaxpg.commands.ending import run_command
from jaxpg.deploy import c, learner_replay
from jaxpg.deploy.controller import Controller, collect_observations, make_command, make_controller
from jaxpg.errors import UserError
from jaxpg.program.networks import make_networks
from jaxpg.store import policies
from jaxpg.store.policies import StoredPolicy

SOURCES = Path(__file__).parent / "microcontroller"
COMPILER, SIZE, QEMU = "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm"
INSTALL = "apt-get install gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm"
CHECKS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wdouble-promotion", "-Werror")
LAYOUT = ("-mthumb", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections", "--specs=nano.specs")
SLOWNESS = 8  # an instruction is 2**8 ns on QEMU's clock: several ticks of any board's timer
TOO_MANY = 0xFFFFFFFF  # ticks of a call that the timer is too short for
PATIENCE = 600  # s, for a program to end


class Core(NamedTuple):
    """A kind of microcontroller.

    Attributes:
      machine: QEMU's board with this core.
      flags: of the compiler.
      megahertz: of a common one, for the estimate.
    """

    machine: str
    flags: tuple[str, ...]
    megahertz: int


class Program(NamedTuple):
    """What runs on a core: a controller or a learner.

    Attributes:
      alone: the file with it and nothing else.
      entry: the function of `alone`.
      main: the file that feeds it.
    """

    alone: str
    entry: str
    main: str


class Outcome(NamedTuple):
    """What came back for `N` rows.

    Attributes:
      numbers: `[N, m]`, float32.
      instructions: of each call, `[N]`.
      stack: bytes that each call took, those of the functions it calls included, `[N]`.
    """

    numbers: np.ndarray
    instructions: np.ndarray
    stack: np.ndarray


CORES = {
    "Cortex-M4F": Core("mps2-an386", ("-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"), 168),
    "Cortex-M3": Core("mps2-an385", ("-mcpu=cortex-m3", "-mfloat-abi=soft"), 72),
    "Cortex-M0": Core("microbit", ("-mcpu=cortex-m0", "-mfloat-abi=soft"), 48),
}
# The last one rounds a x + b once, where the core can: what gcc does by itself if it is not told -std=c99.
BUILDS = [(name, (option,)) for name in CORES for option in ("-Os", "-O2")]
BUILDS += [("Cortex-M4F", ("-O2", "-ffp-contract=fast"))]
CONTROLLER = Program("controller.c", "command", "main.c")
LEARNER = Program("learner.c", "update", "learn.c")


def check_tools() -> None:
    """Looks for the cross compiler, its C library and QEMU.

    Raises:
      UserError: one is missing.
    """
    missing = [tool for tool in (COMPILER, SIZE, QEMU) if shutil.which(tool) is None]
    if COMPILER not in missing and not Path(_output(COMPILER, "-print-file-name=nano.specs").strip()).is_absolute():
        missing.append("newlib")
    if missing:
        raise UserError(f"there is no {', no '.join(missing)}: {INSTALL}")


def built(core: Core, options: Sequence[str], folder: Path, target: str, *arguments: str) -> Path:
    """`folder / target`, compiled for the core with the header policy.h in `folder`."""
    paths = [str(SOURCES / argument) if argument.endswith(".c") else argument for argument in arguments]
    flags = [*CHECKS, *LAYOUT, *core.flags, *options, f"-I{folder}", f"-I{SOURCES}"]
    subprocess.run([COMPILER, *flags, "-o", target, *paths], check=True, cwd=folder)
    return folder / target


def linked(core: Core, options: Sequence[str], folder: Path, target: str, *arguments: str) -> Path:
    """As `built`, with what is called of newlib's libm and libc and of libgcc, and nothing else."""
    memory = ["-nostartfiles", "-Wl,-T," + str(SOURCES / "link.ld")]
    return built(core, options, folder, target, *arguments, *memory, "-lm")


def image(core: Core, options: Sequence[str], folder: Path, program: Program) -> Path:
    """All of what is written into the flash."""
    return linked(core, options, folder, "image.elf", "start.c", "board.c", program.alone, program.main)


def run(core: Core, path: Path, rows: np.ndarray, size: int) -> Outcome:
    """Runs an image under QEMU.

    Args:
      core: it was built for.
      path: of the image; files of the rows and of what comes back are written beside it.
      rows: `[N, n]`, a call for each.
      size: m, how many numbers come back for a row.

    Raises:
      RuntimeError: the program says that something is wrong, has not answered every row, or has a call that the
        timer is too short for: a smaller `SLOWNESS` makes it longer.
    """
    (path.parent / "rows").write_bytes(np.asarray(rows, "<f4").tobytes())
    board = ["-machine", core.machine, "-display", "none", "-monitor", "none", "-serial", "none"]
    ways = ["-icount", f"shift={SLOWNESS}", "-semihosting-config", "enable=on,target=native"]
    command = [QEMU, *board, *ways, "-kernel", path.name]
    ran = subprocess.run(command, cwd=path.parent, capture_output=True, text=True, timeout=PATIENCE, check=False)
    if ran.returncode:
        raise RuntimeError(f"the program failed on {core.machine}, status {ran.returncode}: {ran.stderr}")
    few, many = np.fromfile(path.parent / "results", "<u4", count=2).tolist()
    record = np.dtype([("numbers", "<f4", (size,)), ("ticks", "<u4"), ("stack", "<u4")])
    records = np.fromfile(path.parent / "results", record, offset=8)
    if len(records) != len(rows) or (records["ticks"] == TOO_MANY).any():
        raise RuntimeError(f"{len(records)} of {len(rows)} calls came back, or one was too long for the timer")
    return Outcome(records["numbers"], _instructions(records["ticks"], few, many), records["stack"])


def _instructions(ticks: np.ndarray, few: int, many: int) -> np.ndarray:
    """Of calls with these ticks, where 2,000 have `few` and 2,000,000 have `many`, those of a measurement included."""
    ticks_of_one = (many - few) / 1_998_000
    return np.rint((ticks.astype(float) - few) / ticks_of_one + 2_000).astype(int)


def flash_and_memory(path: Path) -> dict[str, int]:
    """Bytes of an object or an image: code, constants and first values; variables."""
    text, data, bss, *_ = (int(x) for x in _output(SIZE, str(path)).splitlines()[1].split()[:3])
    return {"flash": text + data, "memory": data + bss}


def sizes(core: Core, options: Sequence[str], folder: Path, program: Program) -> dict[str, dict[str, int]]:
    """Bytes of a program's first file alone, and with the library functions that it calls."""
    alone = built(core, options, folder, "alone.o", program.alone, "-c")
    with_libraries = linked(core, options, folder, "alone.elf", program.alone, f"-Wl,-e,{program.entry}")
    return {"alone": flash_and_memory(alone), "with libm and libgcc": flash_and_memory(with_libraries)}


def compared(folder: Path, program: Program, rows: np.ndarray, host: np.ndarray, jax_: np.ndarray) -> dict[str, Any]:
    """A program in all `BUILDS`.

    Args:
      folder: with the header policy.h.
      program: what runs.
      rows: `[N, n]`, what it gets.
      host, jax_: `[N, m]`, what comes back on the host, and from JAX.
    """
    builds = {}
    for name, options in BUILDS:
        core = CORES[name]
        path = image(core, options, folder, program)
        outcome = run(core, path, rows, host.shape[1])
        builds[" ".join([name, *options])] = {
            "difference from host": largest_difference(outcome.numbers, host),
            "numbers with other bits": other_bits(outcome.numbers, host),
            "difference from jax": largest_difference(outcome.numbers, jax_),
            **lengths(outcome.instructions, core.megahertz),
            "bytes": sizes(core, options, folder, program) | {"whole program": flash_and_memory(path)},
            "stack, bytes": int(outcome.stack.max()),
        }
    return {"numbers": host.size, "difference of host from jax": largest_difference(host, jax_), "builds": builds}


def other_bits(found: np.ndarray, expected: np.ndarray) -> int:
    """How many of the float32 numbers are not the same bits."""
    return int(np.sum(found.view(np.uint32) != expected.astype(np.float32).view(np.uint32)))


def lengths(instructions: np.ndarray, megahertz: int) -> dict[str, float]:
    """Of calls with so many instructions."""
    estimate = f"most, us at {megahertz} MHz: an estimate, one instruction a cycle"
    return {
        "instructions, median": int(np.median(instructions)),
        "instructions, most": int(instructions.max()),
        estimate: round(float(instructions.max()) / megahertz, 1),
    }


def a_controller(stored: StoredPolicy, control: Controller, folder: Path) -> dict[str, Any]:
    """The commands for 10,000 observations."""
    obs = collect_observations(stored)
    expected = np.asarray(jax.jit(make_command(stored))(obs), np.float64)
    return compared(folder, CONTROLLER, obs, c.load(control, folder)(obs), expected)


def a_learner(stored: StoredPolicy, control: Controller, folder: Path) -> dict[str, Any]:
    """The parameters after each of 1,000 updates."""
    transition, networks = learner_replay.collect_steps(stored), make_networks(stored.config, stored.env)
    expected = learner_replay.learn(networks, stored.config.algo, stored.policy, control.learner.log_std, transition)
    rows = learner_replay.to_rows(transition)
    return compared(folder, LEARNER, rows, c.compile_example(control, folder / "learn.c")(rows), np.asarray(expected))


def main(arguments: Sequence[str]) -> int:
    Parser(__doc__).parse_args(arguments)
    check_tools()
    result: dict[str, Any] = {"tools": [_output(tool, "--version").splitlines()[0] for tool in (COMPILER, QEMU)]}
    runs = {"controller": (a_controller, ("env=pendulum",)), "learner": (a_learner, ("env=pendulum", "algo=online"))}
    for name, (tried, options) in runs.items():
        with tempfile.TemporaryDirectory() as place:
            folder = Path(place)
            train(folder / "run", *options)
            stored = policies.load(str(folder / "run"))
            control = make_controller(stored, {"policy": "an experiment's"})._replace(name="policy")
            c.write(control, folder)
            result[name] = tried(stored, control, folder)
    print(json.dumps(result, indent=1), file=sys.stderr)
    write_json("microcontroller.json", result)
    return 0


def _output(*command: str) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


if __name__ == "__main__":
    run_command(main)
