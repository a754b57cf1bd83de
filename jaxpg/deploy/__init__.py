"""Exports of policies: the controller as C, ONNX or StableHLO, each compared with its formula."""
