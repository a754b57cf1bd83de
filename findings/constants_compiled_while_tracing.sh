#!/usr/bin/env bash
# jax, make_jaxpr under ensure_compile_time_eval: every operation on constants is compiled and run while tracing.
#
# jax 0.10.1, jaxlib 0.10.1, numpy 2.4.0 (CPython 3.11 or newer).
#
# One would guess: `jax.ensure_compile_time_eval` leaves a trace that the caller is in, so that what follows has concrete
# values; `make_jaxpr`, which starts a trace of its own, works inside as it does outside.
# What happens: the context also reaches into the function that make_jaxpr traces. Each operation there whose operands
# are constants is compiled by XLA, one program for each shape, and run, instead of becoming an equation. The jaxpr is
# shorter, and correct. But of a function with much arithmetic on constants, as the physics of a robot, most of the time
# to trace is XLA compiling operations of a few numbers: 5 of 6 seconds for a seven-joint arm, where nobody had asked for
# a compilation. It shows in no profile of the traced function alone.
#
# Output seen:
#   outside: 50 equations, 0 programs compiled
#   inside: 11 equations, 31 programs compiled
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet jax==0.10.1 jaxlib==0.10.1 numpy==2.4.0
cat > "$folder/program.py" <<'PYTHON'
import jax, jax.numpy as jnp, numpy as np

compiled = 0


def count(event, *_, **__):
    global compiled
    compiled += event.endswith("backend_compile_duration")


jax.monitoring.register_event_duration_secs_listener(count)


def function(x):
    total = x
    for size in range(2, 12):
        axes = jnp.sin(np.ones(size, np.float32)) * 2  # operands are constants
        total = total + (axes.sum() if size == 2 else axes[0])
    return total


def trace(place):
    global compiled
    compiled = 0
    number = len(jax.make_jaxpr(function)(1.0).eqns)
    print(f"{place}: {number} equations, {compiled} programs compiled")
    return number, compiled


jax.make_jaxpr(function)(1.0)
outside = trace("outside")
with jax.ensure_compile_time_eval():
    inside = trace("inside")
assert outside[1] == 0 and inside[1] > 10
assert inside[0] < outside[0]
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
