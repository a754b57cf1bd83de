"""Joins stages into kernels: a CPU runs few large calls faster than many small loops.

See `envs.physics.tiles`, which runs a kernel for some environments at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from jax import lax

from envs.physics.expressions import Expression
from envs.physics.loops import find_loop
from envs.physics.stages import Stage, compile_separately, make_loop, run, select_following

# Equations per kernel. Compile time grows faster than this number, and kernels are compiled in parallel; a seven-joint
# arm runs a seventh slower in three kernels than in one.
KERNEL = 3000


def make_kernel(function: Callable) -> Callable:
    """Makes XLA's CPU compiler turn a function into one kernel, instead of one for every loop in it.

    XLA itself marks the calls of small loops so; here the mark is set explicitly. The compiler ends the process if a
    marked call does not use all its operands after simplification. Hence the call inside the call, whose operands stay,
    and the barrier, which stops constants.
    """
    call = compile_separately(compile_separately(function), xla_cpu_small_call="true")

    def kernel(*arrays):
        return call(*lax.optimization_barrier(arrays))

    return kernel


def join_into_kernels(stages: list[Stage], outputs: Iterable[Expression]) -> list[Stage]:
    """Joins consecutive stages into kernels: large, so that there are few, but small enough to compile fast."""
    groups: list[list[Stage]] = []
    room = 0
    for stage in stages:
        if room < stage.size:
            groups.append([])
            room = KERNEL
        groups[-1].append(stage)
        room -= stage.size
    used = {x.index for x in outputs}
    kernels = []
    for group in reversed(groups):
        kernel = _split_loop(group[0]) if len(group) == 1 and is_large_loop(group[0]) else _join(group, used)
        used |= {x.index for x in kernel.inputs}
        kernels.append(kernel)
    return kernels[::-1]


def is_large_loop(stage: Stage) -> bool:
    """Whether the stage is a loop that is too large for one kernel."""
    return bool(stage.body) and stage.size > KERNEL


def _split_loop(stage: Stage) -> Stage:
    """A loop around kernels, for one that is too large for a kernel."""
    loop, _ = find_loop(stage.outputs[0])
    return make_loop(stage.outputs, join_into_kernels(list(stage.body), select_following(loop)))


def _join(group: list[Stage], used: set[int]) -> Stage:
    """Joins stages into one that stores only the values used outside it."""
    computed = {x.index: x for stage in group for x in stage.outputs}
    given = {x.index: x for stage in group for x in stage.inputs if x.index not in computed}
    outputs = [x for index, x in computed.items() if index in used]

    def compute(*values):
        known = dict(zip(given, values, strict=True))
        run(group, known)
        return [known[x.index] for x in outputs]

    equations = [x for stage in group for x in stage.equations]
    return Stage(equations, list(given.values()), outputs, make_kernel(compute))
