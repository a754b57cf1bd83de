"""`python tests/wrong_sums.py` counts the wrong sums of the installed jaxlib, also of one that jaxpg refuses."""

import jax
import jax.numpy as jnp
import jaxlib


def wrong_sums(calls=40):
    """In how many of the calls a sum of 2 * 1024 * 1024 ones is not that."""
    total = jax.jit(lambda a: jnp.sum(jnp.broadcast_to(a, (2, 1024, 1024))))
    ones = jnp.ones((1024, 1024))
    return sum(float(total(ones)) != 2 * 1024 * 1024 for _ in range(calls))


if __name__ == "__main__":
    print(f"jaxlib {jaxlib.__version__}: {wrong_sums()} of 40 sums are wrong")
