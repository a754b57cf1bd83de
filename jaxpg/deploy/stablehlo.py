"""A controller as a StableHLO program, which `jax.export` reads without jaxpg: `[1, n]` to `[1, m]`.

The batch is fixed: of what newer versions of jax write, older ones run programs of fixed sizes alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.export  # not part of `import jax`
import numpy as np

from jaxpg.deploy.controller import Controller
from jaxpg.deploy.sealing import NO_SEAL, sealed

PLATFORMS = ("cpu", "cuda", "tpu")


def write(controller: Controller, folder: Path, command: Callable[[jax.Array], jax.Array]) -> list[Path]:
    """Writes NAME.stablehlo, and NAME.mlir for whoever wants to read it, into `folder`; returns their paths.

    Args:
      controller: for its name and sizes.
      folder: where to.
      command: the controller as JAX computes it.
    """
    shape = jax.ShapeDtypeStruct((1, controller.observation_size), np.float32)
    exported = jax.export.export(jax.jit(command), platforms=PLATFORMS)(shape)
    exported = dataclasses.replace(exported, fun_name=f"{controller.name} {NO_SEAL}")
    program, text = (folder / f"{controller.name}.{ending}" for ending in ("stablehlo", "mlir"))
    program.write_bytes(sealed(exported.serialize()))
    text.write_bytes(sealed(f"// {NO_SEAL}\n{exported.mlir_module()}".encode()))
    return [program, text]


def load(controller: Controller, folder: Path) -> Callable[[np.ndarray], np.ndarray]:
    """The written controller, `[N, n]` to `[N, m]`: called for one row after the other."""
    exported = jax.export.deserialize(bytearray((folder / f"{controller.name}.stablehlo").read_bytes()))
    rows = jax.jit(lambda obs: jax.lax.map(lambda row: exported.call(row[None])[0], obs))
    return lambda obs: np.asarray(rows(obs))
