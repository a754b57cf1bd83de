"""`python tests/wrong_sums.py` counts the wrong sums of the installed jaxlib, also of one that jaxpg refuses."""

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np

CALLS = 2000  # of each; it is a race between threads, and on a busy machine the first few hundred may all be right
SHAPES = ((2, 1024, 1024), (2, 512, 512), (16, 4096, 8))


def wrong_sums():
    """In how many of the calls the sum of so many ones is not their number."""
    return sum(wrong_sums_of(shape) for shape in SHAPES)


def wrong_sums_of(shape):
    total = jax.jit(lambda a: jnp.sum(jnp.broadcast_to(a, shape)))
    ones = jnp.ones(shape[1:])
    return sum(float(total(ones)) != np.prod(shape) for _ in range(CALLS))


if __name__ == "__main__":
    print(f"jaxlib {jaxlib.__version__}: {wrong_sums():,} of {CALLS * len(SHAPES):,} sums are wrong")
