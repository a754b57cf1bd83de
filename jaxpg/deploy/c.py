"""A controller as one C99 header: no allocation, no library but math.h, weights in constant memory, re-entrant.

The texts are C as it is written, about a controller called `policy`; `_named` gives it its own name.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxpg.deploy import online
from jaxpg.deploy.controller import Controller
from jaxpg.features import BOUND, monomials, num_features
from jaxpg.run.errors import UserError

FLAGS = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wpedantic", "-Werror")

HEADER = """\
#ifndef JAXPG_POLICY_H
#define JAXPG_POLICY_H

#include <math.h>

/* Numbers are float; where POLICY_DOUBLE is defined they are double. */
#ifdef POLICY_DOUBLE
typedef double policy_real;
#define POLICY_F(function) function
#else
typedef float policy_real;
#define POLICY_F(function) function##f
#endif

#define POLICY_OBSERVATIONS {observations}
#define POLICY_COMMANDS {commands}

{arrays}
/* y = W' x + b, with the weights in the order of their use. */
static inline void policy_layer(const policy_real *weight, const policy_real *bias, int inputs, int outputs,
                                const policy_real *x, policy_real *y) {{
    for (int j = 0; j < outputs; j++) y[j] = bias[j];
    for (int i = 0; i < inputs; i++)
        for (int j = 0; j < outputs; j++) y[j] += weight[i * outputs + j] * x[i];
}}

/* What the first layer sees of an observation: {size} numbers. */
static inline void policy_features(const policy_real *observation, policy_real *x) {{
    policy_real z[POLICY_OBSERVATIONS];
    for (int i = 0; i < POLICY_OBSERVATIONS; i++) z[i] = (observation[i] - policy_mean[i]) * policy_scale[i];
{features}
}}

/* Commands of the last layer's numbers. */
static inline void policy_limited(const policy_real *u, policy_real *command) {{
    for (int i = 0; i < POLICY_COMMANDS; i++) {{
        policy_real a = {action};
        command[i] = {command};
    }}
}}

/* The command for an observation, both in the units above. */
static inline void policy_command(const policy_real observation[POLICY_OBSERVATIONS],
                                  policy_real command[POLICY_COMMANDS]) {{
    policy_real x[{width}], y[{width}];
    policy_features(observation, x);
{layers}
    policy_limited(y, command);
}}
{more}
#endif
"""

# Statements that make x of z, by the name of the features.
FEATURES = {
    "identity": """\
    for (int i = 0; i < {size}; i++) x[i] = z[i];
""",
    "polynomial": """\
    for (int i = 0; i < POLICY_OBSERVATIONS; i++) x[i] = z[i];
    for (int i = POLICY_OBSERVATIONS; i < {size}; i++) x[i] = x[policy_factors[2 * i]] * z[policy_factors[2 * i + 1]];
""",
    "fourier": """\
    for (int k = 0; k < {size}; k++) {{ /* k + 1 has the frequencies as its digits */
        policy_real angle = 0;
        for (int i = POLICY_OBSERVATIONS - 1, rest = k + 1; i >= 0; rest /= {order} + 1, i--) {{
            policy_real inside = z[i] > {bound} ? {bound} : z[i] < -{bound} ? -{bound} : z[i];
            angle += (policy_real)(rest % ({order} + 1)) * (inside + {bound}) / {width};
        }}
        x[k] = POLICY_F(cos)((policy_real)3.14159265358979323846 * angle);
    }}
""",
    "radial": """\
    x[0] = 1;
    for (int i = 0, made = 1; i < POLICY_OBSERVATIONS; made *= {order}, i++) {{
        policy_real bump[{order}], largest = 0, sum = 0;
        for (int j = 0; j < {order}; j++) {{
            policy_real away = (z[i] + {bound}) * ({order} - 1) / {width} - (policy_real)j;
            bump[j] = -away * away / 2;
            if (j == 0 || bump[j] > largest) largest = bump[j];
        }}
        for (int j = 0; j < {order}; j++) sum += bump[j] = POLICY_F(exp)(bump[j] - largest);
        for (int k = made - 1; k >= 0; k--) {{ /* from the end: x[k] is read before it is written */
            policy_real before = x[k];
            for (int j = 0; j < {order}; j++) x[k * {order} + j] = before * (bump[j] / sum);
        }}
    }}
""",
}

ACTIVATIONS = {
    "tanh": "POLICY_F(tanh)(y[i])",
    "relu": "y[i] > 0 ? y[i] : 0",
    "elu": "y[i] > 0 ? y[i] : POLICY_F(expm1)(y[i])",
    "swish": "y[i] / (1 + POLICY_F(exp)(-y[i]))",
}

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
        policy_command(observation, command);
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
    texts = {f"{controller.name}.h": header(controller), "Makefile": _named(controller, makefile)}
    texts |= {f"{name}.c": _named(controller, text) for name, text in examples.items()}
    for file, text in texts.items():
        (folder / file).write_text(text, encoding="utf-8")
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
    flags = [*FLAGS, *([_named(controller, "-DPOLICY_DOUBLE")] if double else [])]
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


def header(controller: Controller) -> str:
    """The text of the header."""
    limits = controller.interface.limits
    code = HEADER.format(
        size=_num_features(controller),
        observations=controller.observation_size,
        commands=controller.action_size,
        arrays="\n".join(_arrays(controller)),
        width=max(max(layer.weight.shape) for layer in controller.layers),
        features=_features(controller),
        layers=_layers(controller),
        action="POLICY_F(tanh)(u[i])" if controller.squash else "u[i]",
        more=online.code(controller) if controller.learner else "",
        command="a" if limits is None else "policy_limit[i] * (a > 1 ? 1 : a < -1 ? -1 : a)",
    )
    return "\n".join([*_about(controller), _named(controller, code)])


def _named(controller: Controller, text: str) -> str:
    return text.replace("policy", controller.name).replace("POLICY", controller.name.upper())


def _about(controller: Controller) -> list[str]:
    """What a reader has to know."""
    names, commands, limits = controller.interface
    bounds = [f", at most {x:g} either way" for x in limits] if limits else [""] * len(commands)
    return [
        "/* A controller trained by jaxpg.",
        " *",
        *(f" * {name}: {text}".replace("*/", "* /") for name, text in controller.origin.items()),
        " *",
        *(f" * observation[{i}]: {name}" for i, name in enumerate(names)),
        *(f" * command[{i}]: {name}{bound}" for i, (name, bound) in enumerate(zip(commands, bounds, strict=True))),
        " */",
    ]


def _arrays(controller: Controller) -> list[str]:
    """The constants."""
    arrays = {"mean": controller.mean, "scale": controller.scale}
    for i, layer in enumerate(controller.layers):
        arrays |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
    if controller.interface.limits is not None:
        arrays["limit"] = np.array(controller.interface.limits, np.float32)
    texts = [_array("policy_real", name, [_literal(x) for x in np.ravel(x)]) for name, x in arrays.items()]
    if controller.learner:
        arrays = online.arrays(controller.learner)
        texts += [_array("policy_real", name, [_literal(x) for x in np.ravel(x)]) for name, x in arrays.items()]
    if controller.features == "polynomial":
        factors = _factors(controller.observation_size, controller.order)
        texts.append(_array("unsigned short", "factors", [str(x) for pair in factors for x in pair]))
    return texts


def _array(kind: str, name: str, numbers: list[str]) -> str:
    rows = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    return f"static const {kind} policy_{name}[{len(numbers)}] = {{\n    " + ",\n    ".join(rows) + "};\n"


def _literal(x: np.floating) -> str:
    """All digits of a float32 or a float64."""
    text = f"{x:.9g}" if x.dtype == np.float32 else f"{x:.17g}"
    text = text if set(".e") & set(text) else f"{text}.0"
    return f"{text}f" if x.dtype == np.float32 else text


def _factors(size: int, order: int) -> list[tuple[int, int]]:
    """Of each monomial the one without its last factor, and that factor; (0, 0) for those of degree 1."""
    place = {c: i for i, c in enumerate(monomials(size, order))}
    return [(place[c[:-1]], c[-1]) if len(c) > 1 else (0, 0) for c in place]


def _features(controller: Controller) -> str:
    numbers = {
        "size": _num_features(controller),
        "order": controller.order,
        "bound": f"{BOUND:g}",
        "width": f"{2 * BOUND:g}",
    }
    return FEATURES[controller.features].format(**numbers).rstrip()


def _num_features(controller: Controller) -> int:
    return num_features(controller.features, controller.observation_size, controller.order)


def _layers(controller: Controller) -> str:
    lines = []
    for i, layer in enumerate(controller.layers):
        inputs, outputs = layer.weight.shape
        lines.append(f"policy_layer(policy_weight_{i}, policy_bias_{i}, {inputs}, {outputs}, x, y);")
        if i < len(controller.layers) - 1:
            lines.append(f"for (int i = 0; i < {outputs}; i++) x[i] = {ACTIVATIONS[controller.activation]};")
    return "\n".join(f"    {line}" for line in lines)
