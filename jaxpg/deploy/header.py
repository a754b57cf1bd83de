"""A controller as a C99 header: no allocation, no library but libm, constant weights, re-entrant.

The templates are C code for a controller called `policy`; `rename` puts in the real name.
"""

from __future__ import annotations

import hashlib
import re

import numpy as np

from jaxpg.deploy import c_learner
from jaxpg.deploy.controller import MAX_DEVIATION, Controller
from jaxpg.deploy.identifiers import escape_comment
from jaxpg.deploy.sealing import NO_SEAL
from jaxpg.features import BOUND, monomials
from jaxpg.program.networks import NUM_FEATURES

# Including it twice is fine; including another controller of the same name is an error.
GUARDED = """\
#ifdef JAXPG_POLICY_H
#ifndef JAXPG_POLICY_{digest}
#error "two controllers are called policy here: export one of them with name=ANOTHER"
#endif
#else
#define JAXPG_POLICY_H
#define JAXPG_POLICY_{digest}
{code}
#endif
"""

HEADER = """
#include <math.h>
#include <stdint.h>
#include <string.h>

/* Numbers are float, or double if POLICY_DOUBLE is defined. */
#ifdef POLICY_DOUBLE
typedef double policy_real;
typedef uint64_t policy_bits;
#define POLICY_F(function) function
#else
typedef float policy_real;
typedef uint32_t policy_bits;
#define POLICY_F(function) function##f
#endif

#define POLICY_OBSERVATIONS {observations}
#define POLICY_COMMANDS {commands}

{arrays}
/* y = W' x + b, with the weights in the order in which they are used. */
static inline void policy_layer(const policy_real *weight, const policy_real *bias, int inputs, int outputs,
                                const policy_real *x, policy_real *y) {{
    for (int j = 0; j < outputs; j++) y[j] = bias[j];
    for (int i = 0; i < inputs; i++)
        for (int j = 0; j < outputs; j++) y[j] += weight[i * outputs + j] * x[i];
}}

/* Whether |x| <= bound, compared by bits: with -ffast-math, compilers assume that no number is NaN. */
static inline int policy_within(policy_real x, policy_real bound) {{
    policy_bits bits, most;
    memcpy(&bits, &x, sizeof bits);
    memcpy(&most, &bound, sizeof most);
    return (policy_bits)(bits << 1) <= (policy_bits)(most << 1); /* without the signs */
}}

static inline int policy_finite(policy_real x) {{ return policy_within(x, (policy_real)3.4028234663852886e38); }}

/* The first layer's {size} inputs for an observation. Returns whether it is valid. */
static inline int policy_features(const policy_real *observation, policy_real *x) {{
    policy_real z[POLICY_OBSERVATIONS];
    int valid = 1;
    for (int i = 0; i < POLICY_OBSERVATIONS; i++) {{
        z[i] = (observation[i] - policy_mean[i]) * policy_scale[i];
        valid &= policy_finite(observation[i]) & policy_within(z[i], (policy_real){farthest});
    }}
{features}
    return valid;
}}

static inline int policy_no_command(policy_real *command) {{
    for (int i = 0; i < POLICY_COMMANDS; i++) command[i] = 0;
    return 0;
}}

/* Commands for the last layer's outputs. */
static inline int policy_limited(const policy_real *u, policy_real *command) {{
    int valid = 1;
    for (int i = 0; i < POLICY_COMMANDS; i++) {{
        policy_real a = {action};
        valid &= policy_finite(a);
        command[i] = {command};
    }}
    return valid ? 1 : policy_no_command(command);
}}

/* The command for an observation, both in the units above. Returns 1; or 0, with every command 0, if the observation is
   not valid: one of its numbers is NaN, infinite, or over a million standard deviations from training's mean. */
static inline int policy_command(const policy_real observation[POLICY_OBSERVATIONS],
                                 policy_real command[POLICY_COMMANDS]) {{
    policy_real x[{width}], y[{width}];
    if (!policy_features(observation, x)) return policy_no_command(command);
{layers}
    return policy_limited(y, command);
}}
{more}"""

# Statements that compute x from z, by name of the features.
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

# Each propagates NaN.
ACTIVATIONS = {
    "tanh": "POLICY_F(tanh)(y[i])",
    "relu": "y[i] < 0 ? 0 : y[i]",
    "elu": "y[i] < 0 ? POLICY_F(expm1)(y[i]) : y[i]",
    "swish": "y[i] / (1 + POLICY_F(exp)(-y[i]))",
}


def make_header(controller: Controller) -> str:
    """The text of the header."""
    limits = controller.interface.limits
    code = HEADER.format(
        size=_num_features(controller),
        observations=controller.observation_size,
        commands=controller.action_size,
        arrays="\n".join(_make_arrays(controller)),
        width=max(max(layer.weight.shape) for layer in controller.layers),
        features=_make_features(controller),
        layers=_make_layers(controller),
        action="POLICY_F(tanh)(u[i])" if controller.squash else "u[i]",
        more=c_learner.make_code(controller, controller.learner) if controller.learner else "",
        farthest=MAX_DEVIATION,
        command="a" if limits is None else "policy_limit[i] * (a > 1 ? 1 : a < -1 ? -1 : a)",
    )
    digest = hashlib.sha256(code.encode()).hexdigest()[:16]
    return "\n".join([*_describe(controller), rename(controller, GUARDED.format(digest=digest, code=code))])


def rename(controller: Controller, text: str) -> str:
    """C code for a controller called `policy`, with this controller's name instead."""
    names = {"policy": controller.name, "POLICY": controller.name.upper()}
    return re.sub("policy|POLICY", lambda match: names[match[0]], text)


def _describe(controller: Controller) -> list[str]:
    """The comment at the top: origin, observations and commands."""
    names, commands, limits = controller.interface
    bounds = [""] * len(commands) if limits is None else [f", at most {x:g} either way" for x in limits]
    lines = [f"{name}: {text}" for name, text in controller.origin.items()]
    lines += ["", *(f"observation[{i}]: {name}" for i, name in enumerate(names))]
    lines += [f"command[{i}]: {name}{bound}" for i, (name, bound) in enumerate(zip(commands, bounds, strict=True))]
    return [
        f"/* {NO_SEAL}",
        " * A controller trained by jaxpg.",
        " *",
        *(f" * {escape_comment(x)}".rstrip() for x in lines),
        " */",
    ]


def _make_arrays(controller: Controller) -> list[str]:
    """The constants."""
    arrays = {"mean": controller.mean, "scale": controller.scale}
    for i, layer in enumerate(controller.layers):
        arrays |= {f"weight_{i}": layer.weight, f"bias_{i}": layer.bias}
    if controller.interface.limits is not None:
        arrays["limit"] = np.array(controller.interface.limits, np.float32)
    if controller.learner:
        arrays |= c_learner.make_arrays(controller.learner)
    texts = [
        _format_array("policy_real", name, [_format_literal(x) for x in np.ravel(array)])
        for name, array in arrays.items()
    ]
    if controller.features == "polynomial":
        factors = _find_factors(controller.observation_size, controller.order)
        texts.append(_format_array("unsigned short", "factors", [str(x) for pair in factors for x in pair]))
    return texts


def _format_array(kind: str, name: str, numbers: list[str]) -> str:
    rows = [", ".join(numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
    return f"static const {kind} policy_{name}[{len(numbers)}] = {{\n    " + ",\n    ".join(rows) + "};\n"


def _format_literal(x: np.floating) -> str:
    """All digits of a float32 or a float64."""
    text = f"{x:.9g}" if x.dtype == np.float32 else f"{x:.17g}"
    text = text if set(".e") & set(text) else f"{text}.0"
    return f"{text}f" if x.dtype == np.float32 else text


def _find_factors(size: int, order: int) -> list[tuple[int, int]]:
    """For each monomial, the monomial without its last factor, and that factor; (0, 0) for degree 1."""
    place = {c: i for i, c in enumerate(monomials(size, order))}
    return [(place[c[:-1]], c[-1]) if len(c) > 1 else (0, 0) for c in place]


def _make_features(controller: Controller) -> str:
    numbers = {
        "size": _num_features(controller),
        "order": controller.order,
        "bound": f"{BOUND:g}",
        "width": f"{2 * BOUND:g}",
    }
    return FEATURES[controller.features].format(**numbers).rstrip()


def _num_features(controller: Controller) -> int:
    return NUM_FEATURES[controller.features](controller.observation_size, controller.order)


def _make_layers(controller: Controller) -> str:
    lines = []
    for i, layer in enumerate(controller.layers):
        inputs, outputs = layer.weight.shape
        lines.append(f"policy_layer(policy_weight_{i}, policy_bias_{i}, {inputs}, {outputs}, x, y);")
        if i < len(controller.layers) - 1:
            lines.append(f"for (int i = 0; i < {outputs}; i++) x[i] = {ACTIVATIONS[controller.activation]};")
    return "\n".join(f"    {line}" for line in lines)
