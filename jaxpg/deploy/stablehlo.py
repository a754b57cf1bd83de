"""A controller as a StableHLO program, which `jax.export` reads without jaxpg: `[1, n]` to `[1, m]`.

The batch size is fixed: older versions of jax only run programs of newer ones if all sizes are fixed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.export  # not part of `import jax`
import numpy as np

from jaxpg.deploy.controller import Controller
from jaxpg.deploy.sealing import NO_SEAL, add_seal

PLATFORMS = ("cpu", "cuda", "tpu")


def write(controller: Controller, folder: Path, command: Callable[[jax.Array], jax.Array]) -> list[Path]:
    """Writes NAME.stablehlo and, for reading, NAME.mlir into `folder`; returns their paths.

    Args:
      controller: has the name and sizes.
      folder: where to write.
      command: the controller in JAX.
    """
    shape = jax.ShapeDtypeStruct((1, controller.observation_size), np.float32)
    exported = jax.export.export(jax.jit(command), platforms=PLATFORMS)(shape)
    exported = dataclasses.replace(exported, fun_name=f"{controller.name} {NO_SEAL}")
    program, text = (folder / f"{controller.name}.{ending}" for ending in ("stablehlo", "mlir"))
    program.write_bytes(add_seal(bytes(exported.serialize())))
    text.write_bytes(add_seal(f"// {NO_SEAL}\n{exported.mlir_module()}".encode()))
    return [program, text]


def load(controller: Controller, folder: Path) -> Callable[[np.ndarray], np.ndarray]:
    """The exported controller, `[N, n]` to `[N, m]`, called row by row."""
    exported = jax.export.deserialize(bytearray((folder / f"{controller.name}.stablehlo").read_bytes()))
    rows = jax.jit(lambda obs: jax.lax.map(lambda row: exported.call(row[None])[0], obs))
    return lambda obs: np.asarray(rows(obs))
