"""A controller as an ONNX model: `observation` `[batch, n]` to `command` `[batch, m]`, for any batch.

The commands of a row are 0 if its observation is not valid, as in `jaxpg.deploy.controller`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from jaxpg.deploy.controller import MAX_DEVIATION, Controller
from jaxpg.deploy.sealing import NO_SEAL, add_seal
from jaxpg.features import BOUND

OPSET = 18  # from 2022: common runtimes support it
IR_VERSION = 8  # the one that belongs to it
FLOAT = 1  # onnx.TensorProto.FLOAT


class Graph:
    """The nodes and constants of a model under construction; values are referred to by name."""

    def __init__(self, helper: Any, numpy_helper: Any):
        self._helper, self._numpy_helper = helper, numpy_helper
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, dtype: type = np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(self._numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def node(self, kind: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        name = name or f"{kind.lower()}_{len(self.nodes)}"
        self.nodes.append(self._helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def columns(self, x: str, places: list[int]) -> str:
        """The given columns of `[batch, n]`."""
        return self.node("Gather", x, self.constant(places, np.int64), axis=1)


def write(controller: Controller, folder: Path) -> list[Path]:
    """Writes NAME.onnx into `folder`; returns its path."""
    from onnx import TensorProto, checker, helper, numpy_helper

    graph = Graph(helper, numpy_helper)
    _add_command(graph, controller)
    values = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["batch", size])
        for name, size in (("observation", controller.observation_size), ("command", controller.action_size))
    ]
    body = helper.make_graph(graph.nodes, controller.name, values[:1], values[1:], graph.constants)
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="jaxpg")
    model.ir_version = IR_VERSION
    names, commands, limits = controller.interface
    metadata = {
        "observations": "; ".join(names),
        "commands": "; ".join(commands),
        "limits": str(limits),
        "seal": NO_SEAL,
    }
    helper.set_model_props(model, controller.origin | metadata)
    checker.check_model(model, full_check=True)
    path = folder / f"{controller.name}.onnx"
    path.write_bytes(add_seal(model.SerializeToString()))
    return [path]


def load(controller: Controller, folder: Path) -> Callable[[np.ndarray], np.ndarray]:
    """The exported controller, `[N, n]` to `[N, m]`, in onnxruntime."""
    import onnxruntime

    path = str(folder / f"{controller.name}.onnx")
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return lambda obs: np.asarray(session.run(["command"], {"observation": obs})[0])


def _add_command(graph: Graph, controller: Controller) -> None:
    centred = graph.node("Sub", "observation", graph.constant(controller.mean))
    z = graph.node("Mul", centred, graph.constant(controller.scale))
    x = FEATURES[controller.features](graph, z, controller)
    for layer in controller.layers[:-1]:
        x = ACTIVATIONS[controller.activation](graph, _add_layer(graph, x, layer))
    action = _add_layer(graph, x, controller.layers[-1])
    if controller.squash:
        action = graph.node("Tanh", action)
    limited = action if controller.interface.limits is None else _clip(graph, action, controller.interface.limits)
    valid = graph.node("And", _is_within(graph, z, MAX_DEVIATION), _is_within(graph, action, np.finfo(np.float32).max))
    graph.node("Where", valid, limited, graph.constant(0), name="command")


def _clip(graph: Graph, action: str, limits: tuple[float, ...]) -> str:
    return graph.node("Mul", graph.node("Clip", action, graph.constant(-1), graph.constant(1)), graph.constant(limits))


def _is_within(graph: Graph, x: str, bound: float | np.floating) -> str:
    """Whether all |x| of a row are at most `bound`, `[batch, 1]`; false for NaN."""
    small = graph.node("LessOrEqual", graph.node("Abs", x), graph.constant(bound))
    smallest = graph.node("ReduceMin", graph.node("Cast", small, to=FLOAT), graph.constant([1], np.int64), keepdims=1)
    return graph.node("Greater", smallest, graph.constant(0.5))


def _add_layer(graph: Graph, x: str, layer: Any) -> str:
    return graph.node("Gemm", x, graph.constant(layer.weight), graph.constant(layer.bias))


def _polynomial(graph: Graph, z: str, controller: Controller) -> str:
    size, terms = controller.observation_size, [(i,) for i in range(controller.observation_size)]
    degrees = [z]
    for degree in range(2, controller.order + 1):
        place, terms = (
            {c: i for i, c in enumerate(terms)},
            [*itertools.combinations_with_replacement(range(size), degree)],
        )
        rest = graph.columns(degrees[-1], [place[c[:-1]] for c in terms])
        degrees.append(graph.node("Mul", rest, graph.columns(z, [c[-1] for c in terms])))
    return graph.node("Concat", *degrees, axis=1)


def _fourier(graph: Graph, z: str, controller: Controller) -> str:
    inside = graph.node("Clip", z, graph.constant(-BOUND), graph.constant(BOUND))
    unit = graph.node("Div", graph.node("Add", inside, graph.constant(BOUND)), graph.constant(2 * BOUND))
    frequencies = [*itertools.product(range(controller.order + 1), repeat=controller.observation_size)][1:]
    angle = graph.node(
        "MatMul", graph.node("Mul", unit, graph.constant(np.pi)), graph.constant(np.transpose(frequencies))
    )
    return graph.node("Cos", angle)


def _radial(graph: Graph, z: str, controller: Controller) -> str:
    order = controller.order
    axis, width = np.linspace(-BOUND, BOUND, order), 2 * BOUND / (order - 1)

    def bump(i: int) -> str:
        distance = graph.node(
            "Div", graph.node("Sub", graph.columns(z, [i]), graph.constant(axis)), graph.constant(width)
        )
        energy = graph.node("Mul", graph.node("Mul", distance, distance), graph.constant(-0.5))
        return graph.node("Softmax", energy, axis=1)

    bumps = bump(0)
    for i in range(1, controller.observation_size):
        pair = (bumps, 2), (bump(i), 1)
        one, two = (graph.node("Unsqueeze", x, graph.constant([axis], np.int64)) for x, axis in pair)
        bumps = graph.node("Reshape", graph.node("Mul", one, two), graph.constant([-1, order ** (i + 1)], np.int64))
    return bumps


FEATURES = {
    "identity": lambda graph, z, controller: z,
    "polynomial": _polynomial,
    "fourier": _fourier,
    "radial": _radial,
}
ACTIVATIONS = {
    "tanh": lambda graph, x: graph.node("Tanh", x),
    "relu": lambda graph, x: graph.node("Relu", x),
    "elu": lambda graph, x: graph.node("Elu", x),
    "swish": lambda graph, x: graph.node("Mul", x, graph.node("Sigmoid", x)),
}
