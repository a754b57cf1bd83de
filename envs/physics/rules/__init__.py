"""One rule per jax primitive: its effect on arrays of scalar expressions.

A rule takes the aval (shape and dtype) of its first result, the operands (`envs.physics.arrays`) and the primitive's
parameters, and returns the result, or a tuple of results.

To add a primitive, add a function `(aval, x, y, *, parameter, **_)` to one of the modules here, and a line to its
RULES. A primitive without a rule raises `UnsupportedPrimitiveError`.
"""

from collections.abc import Callable
from typing import Any

from envs.physics.rules import creation, elementwise, indexing, layout, linear_algebra, reductions, sorting

RULES: dict[str, Callable[..., Any]] = {
    **elementwise.RULES,
    **creation.RULES,
    **layout.RULES,
    **indexing.RULES,
    **reductions.RULES,
    **sorting.RULES,
    **linear_algebra.RULES,
}
