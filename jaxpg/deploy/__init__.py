"""Policies that leave the library: the controller as C, ONNX or StableHLO, each compared with its formula."""
