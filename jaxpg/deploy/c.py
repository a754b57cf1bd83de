"""A controller in C: its header, examples of its use and their Makefile; written, compiled and run."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxpg.deploy import online
from jaxpg.deploy.controller import Controller
from jaxpg.deploy.header import header, named
from jaxpg.deploy.sealing import NO_SEAL, sealed
from jaxpg.errors import UserError

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")

EXAMPLE = """\
/* Reads observations from standard input, number after number; writes a line with the commands of each. */
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
    """Writes NAME.h, an example of each of its uses, and their Makefile into `folder`; returns their paths."""
    examples = {"main": EXAMPLE} | ({"learn": online.EXAMPLE} if controller.learner else {})
    makefile = MAKEFILE.format(programs=" ".join(examples), flags=" ".join(FLAGS))
    texts = {f"{controller.name}.h": header(controller), "Makefile": f"# {NO_SEAL}\n{named(controller, makefile)}"}
    texts |= {f"{name}.c": f"/* {NO_SEAL} */\n{named(controller, text)}" for name, text in examples.items()}
    for file, text in texts.items():
        (folder / file).write_bytes(sealed(text.encode()))
    return [folder / file for file in texts]


def load(controller: Controller, folder: Path, double: bool = False) -> Callable[[np.ndarray], np.ndarray]:
    """The written controller, `[N, n]` to `[N, m]`: its own example, compiled, and run for each array.

    Args:
      controller, folder: as for `write`.
      double: compute with double in the place of float.

    Raises:
      UserError: there is no C compiler.
    """
    return program(controller, folder / "main.c", double)


def program(controller: Controller, source: Path, double: bool = False) -> Callable[[np.ndarray], np.ndarray]:
    """An example, compiled without a warning: rows of numbers on its standard input to rows on its standard output.

    Raises:
      UserError: there is no C compiler.
    """
    flags = [*FLAGS, *([named(controller, "-DPOLICY_DOUBLE")] if double else [])]
    compiled = source.with_suffix("")
    build = [compiler(), *flags, "-o", str(compiled), str(source), "-lm"]
    built = subprocess.run(build, capture_output=True, text=True, check=False)
    if built.returncode:
        raise RuntimeError(f"{source} does not compile:\n{built.stderr}")

    def run(rows: np.ndarray) -> np.ndarray:
        lines = "\n".join(" ".join(f"{x:.17g}" for x in row) for row in rows)
        output = subprocess.run([str(compiled)], input=lines, capture_output=True, text=True, check=True).stdout
        return np.array([line.split() for line in output.splitlines()], np.float64)

    return run


def compiler() -> str:
    """The C compiler that the variable CC names, or the system's.

    Raises:
      UserError: there is none.
    """
    asked = os.environ.get("CC", "cc")
    found = shutil.which(asked)
    if found is None:
        raise UserError(f"format=c is tried out by a C compiler, and there is no {asked}: install gcc, or set CC")
    return found
