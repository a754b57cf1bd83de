"""A controller in C: writes its header, examples and their Makefile; compiles and runs the examples."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxpg.deploy import c_learner
from jaxpg.deploy.controller import Controller
from jaxpg.deploy.header import make_header, rename
from jaxpg.deploy.sealing import NO_SEAL, add_seal
from jaxpg.errors import UserError

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")

EXAMPLE = """\
/* Reads observations from standard input, number by number; writes a line with the commands for each. */
#include <stdio.h>

#include "policy.h"

int main(void) {
    policy_real observation[POLICY_OBSERVATIONS], command[POLICY_COMMANDS];
    double number;
    int known = 0;
    while (scanf("%lf", &number) == 1) {
        observation[known++] = (policy_real)number;
        if (known < POLICY_OBSERVATIONS) continue;
        known = 0;
        if (!policy_command(observation, command)) fprintf(stderr, "not a valid observation\\n");
        for (int i = 0; i < POLICY_COMMANDS; i++) printf("%.17g ", (double)command[i]);
        printf("\\n");
    }
    return 0;
}
"""

MAKEFILE = """\
all: {programs}

%: %.c policy.h
\t$(CC) {flags} -o $@ $< -lm
"""


def write(controller: Controller, folder: Path) -> list[Path]:
    """Writes NAME.h, its examples and their Makefile into `folder`; returns their paths."""
    examples = {"main": EXAMPLE} | ({"learn": c_learner.EXAMPLE} if controller.learner else {})
    makefile = MAKEFILE.format(programs=" ".join(examples), flags=" ".join(FLAGS))
    texts = {
        f"{controller.name}.h": make_header(controller),
        "Makefile": f"# {NO_SEAL}\n{rename(controller, makefile)}",
    }
    texts |= {f"{name}.c": f"/* {NO_SEAL} */\n{rename(controller, text)}" for name, text in examples.items()}
    for file, text in texts.items():
        (folder / file).write_bytes(add_seal(text.encode()))
    return [folder / file for file in texts]


def load(controller: Controller, folder: Path, double: bool = False) -> Callable[[np.ndarray], np.ndarray]:
    """The exported controller, `[N, n]` to `[N, m]`: its example, compiled, and run for each array.

    Args:
      controller, folder: as in `write`.
      double: compute in double instead of float.

    Raises:
      UserError: there is no C compiler.
    """
    return compile_example(controller, folder / "main.c", double)


def compile_example(controller: Controller, source: Path, double: bool = False) -> Callable[[np.ndarray], np.ndarray]:
    """Compiles an example without warnings; returns a function from its input rows to its output rows.

    Raises:
      UserError: there is no C compiler.
    """
    flags = [*FLAGS, *([rename(controller, "-DPOLICY_DOUBLE")] if double else [])]
    executable = source.with_suffix("")
    command = [find_compiler(), *flags, "-o", str(executable), str(source), "-lm"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode:
        raise RuntimeError(f"{source} does not compile:\n{result.stderr}")

    def run(rows: np.ndarray) -> np.ndarray:
        lines = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in rows)
        output = subprocess.run([str(executable)], input=lines, capture_output=True, text=True, check=True).stdout
        return np.array([line.split() for line in output.splitlines()], np.float64)

    return run


def find_compiler() -> str:
    """Path of the C compiler: the one that the environment variable CC names, or the system's `cc`.

    Raises:
      UserError: there is none.
    """
    name = os.environ.get("CC", "cc")
    path = shutil.which(name)
    if path is None:
        raise UserError(f"format=c is tested with a C compiler, and there is no {name}: install gcc, or set CC")
    return path
