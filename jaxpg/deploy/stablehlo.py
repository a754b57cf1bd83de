"""A controller as a StableHLO program, which `jax.export` reads without jaxpg: `[batch, n]` to `[batch, m]`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import jax
import jax.export  # not part of `import jax`
import numpy as np

from jaxpg.deploy.controller import Controller

PLATFORMS = ("cpu", "cuda", "tpu")


def write(controller: Controller, folder: Path, command: Callable[[jax.Array], jax.Array]) -> list[Path]:
    """Writes NAME.stablehlo, and NAME.mlir for whoever wants to read it, into `folder`; returns their paths.

    Args:
      controller: for its name and sizes.
      folder: where to.
      command: the controller as JAX computes it.
    """
    (batch,) = jax.export.symbolic_shape("batch")
    shape = jax.ShapeDtypeStruct((batch, controller.observation_size), np.float32)
    exported = jax.export.export(jax.jit(command), platforms=PLATFORMS)(shape)
    program, text = (folder / f"{controller.name}.{ending}" for ending in ("stablehlo", "mlir"))
    program.write_bytes(exported.serialize())
    text.write_text(exported.mlir_module(), encoding="utf-8")
    return [program, text]


def load(controller: Controller, folder: Path) -> Callable[[np.ndarray], np.ndarray]:
    """The written controller, `[N, n]` to `[N, m]`."""
    exported = jax.export.deserialize(bytearray((folder / f"{controller.name}.stablehlo").read_bytes()))
    return lambda obs: np.asarray(exported.call(obs))
