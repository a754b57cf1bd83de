"""Numbers as short text, for pages."""

from __future__ import annotations

import base64

import numpy as np

INT16 = 2**15 - 1


def pack(values: np.ndarray) -> str:
    """Numbers within +-32767 as base64 of little-endian int16."""
    return base64.b64encode(np.rint(values).astype("<i2").tobytes()).decode("ascii")


def pack_columns(values: np.ndarray) -> tuple[str, list[float]]:
    """Packed numbers `[F, n]`, each column in its own unit, and the units `[n]`: number = unit * packed."""
    units = np.maximum(np.abs(values).max(axis=0, initial=0.0), 1e-9) / INT16
    return pack(values / units), [float(f"{unit:.8g}") for unit in units]
