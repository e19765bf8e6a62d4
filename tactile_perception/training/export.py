"""Export of a trained network to ONNX: batch normalization folded, dropout gone, metadata inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from tactile_perception.model_metadata import INPUT_NAME, OUTPUT_NAMES, ModelMetadata
from tactile_perception.training.gdn import OUTPUTS, ConvBlock, Gdn

OPSET = 17
IR_VERSION = 8


def export_onnx(network: Gdn, path: Path | str, metadata: ModelMetadata) -> Path:
    """Write `network` as it answers in evaluation mode.

    The graph is written node by node rather than traced: it stays the same for every PyTorch version, and
    its names are readable. Input `image` float32 (N, 1, size, size) in [0, 1]; outputs `mu` and
    `inverse_sigma`, float32 (N, 6), in mm and rad.
    """
    graph = _Graph()
    last = INPUT_NAME
    for index, block in enumerate(network.base):
        assert isinstance(block, ConvBlock)
        last = graph.block(f"block{index + 1}", last, *_folded(block))
    last = graph.node("Flatten", [last], "features", axis=1)
    head = network.head
    weight = graph.constant("head.weight", (head.gain * head.weight.detach()).numpy())
    bias = graph.constant("head.bias", head.bias.detach().numpy())
    last = graph.node("Gemm", [last, weight, bias], "head", transB=1)
    mu, inverse_sigma = OUTPUT_NAMES
    sizes = graph.constant("split", np.array([OUTPUTS, OUTPUTS], dtype=np.int64))
    graph.nodes.append(helper.make_node("Split", [last, sizes], [mu, "unbounded"], axis=1))
    graph.softbound("unbounded", inverse_sigma, *network.settings.inverse_sigma_bounds)
    model = graph.model(network.settings.image_size)
    helper.set_model_props(model, metadata.to_properties())
    onnx.checker.check_model(model)
    path = Path(path)
    onnx.save_model(model, str(path))
    return path


def _folded(block: ConvBlock) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weight and bias of one convolution that does what convolution and normalization do."""
    convolution, norm = block[0], block[1]
    assert isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
    assert norm.running_var is not None and norm.running_mean is not None
    scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).detach()
    weight = convolution.weight.detach() * scale[:, None, None, None]
    bias = norm.bias.detach() - norm.running_mean * scale
    return weight.contiguous().numpy(), bias.numpy()


class _Graph:
    """Collects the nodes and constants of an ONNX graph."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: NDArray) -> str:
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def node(self, operation: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operation, inputs, [output], name=output, **attributes))
        return output

    def block(self, name: str, source: str, weight: NDArray, bias: NDArray) -> str:
        """Convolution, ReLU, max-pooling (in the order that runtimes fuse)."""
        parameters = [self.constant(f"{name}.weight", weight), self.constant(f"{name}.bias", bias)]
        last = self.node(
            "Conv",
            [source, *parameters],
            f"{name}.conv",
            kernel_shape=[3, 3],
            pads=[1, 1, 1, 1],
            strides=[1, 1],
        )
        last = self.node("Relu", [last], f"{name}.relu")
        return self.node("MaxPool", [last], f"{name}.pool", kernel_shape=[2, 2], strides=[2, 2])

    def softbound(self, source: str, output: str, lower: float, upper: float) -> None:
        """clamp(x) + (log1p(exp(-|x - lower|)) - log1p(exp(-|x - upper|))), held to its bounds."""
        low, high = (
            self.constant(f"softbound.{name}", np.array(value, dtype=np.float32))
            for name, value in (("lower", lower), ("upper", upper))
        )
        one = self.constant("softbound.one", np.array(1.0, dtype=np.float32))
        terms = []
        for name, bound in (("lower", low), ("upper", high)):
            last = self.node("Sub", [source, bound], f"softbound.{name}.difference")
            last = self.node("Abs", [last], f"softbound.{name}.distance")
            last = self.node("Neg", [last], f"softbound.{name}.exponent")
            last = self.node("Exp", [last], f"softbound.{name}.exp")
            last = self.node("Add", [last, one], f"softbound.{name}.sum")
            terms.append(self.node("Log", [last], f"softbound.{name}.log"))
        smooth = self.node("Sub", terms, "softbound.correction")
        clamped = self.node("Clip", [source, low, high], "softbound.clamp")
        total = self.node("Add", [clamped, smooth], "softbound.total")
        self.node("Clip", [total, low, high], output)

    def model(self, image_size: int) -> onnx.ModelProto:
        """The whole model, with a free batch size."""
        image = helper.make_tensor_value_info(INPUT_NAME, TensorProto.FLOAT, ["N", 1, image_size, image_size])
        outputs = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", OUTPUTS]) for name in OUTPUT_NAMES
        ]
        graph = helper.make_graph(self.nodes, "gdn", [image], outputs, self.constants)
        return helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="tactile_servoing",
        )
