"""The jaxlib releases that must not be used, or not with several threads."""

from __future__ import annotations

import re

# Releases whose CPU reductions are wrong: jit(lambda a: jnp.sum(jnp.broadcast_to(a, (2, 1024, 1024)))) of ones differs
# from 2097152 in up to two thirds of the calls, on more than one thread. `python tests/wrong_sums.py` reproduces it if
# one of them is installed; with 0.10.1, and from 0.12.0 on, it finds none.
WRONG_SUMS = ("0.10.2", "0.11.0", "0.11.1", "0.11.2")
# The last release that can deadlock when batched LAPACK calls fill XLA's thread pool. The shipped environments make no
# such calls; brax's and Playground's do.
LAST_DEADLOCK = (0, 11, 0)


def check_jaxlib(version: str) -> None:
    """Raises ImportError if this version of jaxlib computes wrong numbers on a CPU.

    >>> check_jaxlib("0.10.1")
    """
    if version in WRONG_SUMS:
        raise ImportError(f"jaxlib {version} computes wrong sums on a CPU; install another one, 'jax!=0.10.2,!=0.11.*'")


def may_deadlock(version: str) -> bool:
    """Whether this version of jaxlib can hang in concurrent batched LAPACK calls, unless it has one thread.

    >>> may_deadlock("0.10.1"), may_deadlock("0.12.0.1"), may_deadlock("0.13rc1")
    (True, False, False)
    """
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3]) <= LAST_DEADLOCK
