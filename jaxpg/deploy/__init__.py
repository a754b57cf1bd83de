"""Policies that leave the library: the whole controller as C, ONNX or StableHLO, each compared with JAX."""
