"""Export of a trained network to ONNX: batch normalization folded, dropout gone, metadata inside."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from tactile_base.whole_file import whole_file
from tactile_perception.estimating.model_metadata import (
    COVARIANCE,
    INPUT_NAME,
    INVERSE_SIGMA,
    MEAN,
    ModelMetadata,
    output_shapes,
    summed,
)
from tactile_perception.training.convolutions import ConvBlock
from tactile_perception.training.heads import COMPONENTS_OF_MIXTURE, FullGaussianHead, Head
from tactile_perception.training.network import PoseNetwork
from tactile_perception.training.registration import Registration
from tactile_perception.training.settings import NetworkSettings

OPSET = 17
IR_VERSION = 8


def export_onnx(
    network: PoseNetwork, path: Path | str, metadata: ModelMetadata, sigma: NDArray[np.float64] | None = None
) -> Path:
    """Write `network` as it answers in evaluation mode.

    The graph is written node by node rather than traced: it stays the same for every PyTorch version, and
    its names are readable. Input `image` float32 (N, channels, size, size) in [0, 1]; outputs float32, in mm,
    rad and N: `mu` (N, K), and `inverse_sigma` (N, K) or `covariance` (N, K, K). What no label has fixed is
    answered with its prior.

    Parameters
    ----------
    sigma : (K,), needed by a network without uncertainty of its own (head mse)
        The standard deviations in mm, rad and N that its file then states for every image.
    """
    settings, graph = network.settings, GraphWriter()
    if isinstance(network.base, Registration):
        last = _write_registration(graph, network.base, settings)
    else:
        last = _write_blocks(graph, "", INPUT_NAME, network.base, settings)
    for index, layer in enumerate(part for part in network.hidden if isinstance(part, nn.Linear)):
        last = graph.linear(f"hidden{index + 1}", last, layer.weight, layer.bias)
        sigmoid = graph.node("Sigmoid", [last], f"{last}.sigmoid")
        last = graph.node("Mul", [last, sigmoid], f"{last}.silu")
    head = network.head
    last = graph.linear("head", last, head.gain * head.weight, head.bias)
    second = write_head(graph, last, network.distribution, sigma)
    model = graph.model(
        network.channels, settings.image_size, (MEAN, second), network.distribution.model.size
    )
    onnx.checker.check_model(model)
    return save_model(model, path, metadata)


def save_model(model: onnx.ModelProto, path: Path | str, metadata: ModelMetadata) -> Path:
    """Write a model with this metadata in place of what it has, whole or not at all, and make its folder."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    del model.metadata_props[:]
    helper.set_model_props(model, metadata.to_properties())
    with whole_file(path) as temporary:
        temporary.write_bytes(summed(model.SerializeToString()))
    return path


def _write_blocks(
    graph: GraphWriter, prefix: str, source: str, blocks: nn.Sequential, settings: NetworkSettings
) -> str:
    """From images to flat features; returns their name."""
    for index, block in enumerate(blocks):
        assert isinstance(block, ConvBlock)
        stride = settings.first_stride if index == 0 else 1
        source = graph.block(
            f"{prefix}block{index + 1}", source, *_folded(block, stride), stride, block.pooled
        )
    return graph.node("Flatten", [source], f"{prefix}features", axis=1)


def _write_registration(graph: GraphWriter, base: Registration, settings: NetworkSettings) -> str:
    """From images to the modes of the markers' displacement field, as `Registration.forward`."""
    size, features = base.size, _write_blocks(graph, "coarse.", INPUT_NAME, base.first, settings)
    coarse = graph.linear("coarse", features, base.coarse.gain * base.coarse.weight, base.coarse.bias)
    shift = graph.node("MatMul", [coarse, graph.constant("shifts", base.shifts.numpy())], "shift")
    grid = graph.node("Add", [shift, graph.constant("rest", base.rest.numpy())], "grid.flat")
    grid = graph.reshape(grid, (-1, size, size, 2), "grid")
    back = graph.node("GridSample", [INPUT_NAME, grid], "pulled_back", mode="bilinear", align_corners=0)
    features = _write_blocks(graph, "fine.", back, base.second, settings)
    rest = graph.linear("fine", features, base.fine.gain * base.fine.weight, base.fine.bias)
    places = graph.constant("coarse.places", np.eye(base.coarse_count, base.count))
    known = graph.node("MatMul", [coarse, places], "coarse.modes")
    return graph.node("Add", [rest, known], "modes")


def _folded(block: ConvBlock, stride: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Weight and bias of one convolution that does what unshuffling, convolution and normalization do."""
    convolution, norm = block[0], block[1]
    assert isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d)
    assert norm.running_var is not None and norm.running_mean is not None
    scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).detach()
    weight = convolution.weight.detach() * scale[:, None, None, None]
    bias = norm.bias.detach() - norm.running_mean * scale
    if stride > 1:
        # Channel (dy, dx) of tap (i, j) is pixel (i stride + dy, j stride + dx) of the larger kernel.
        weight = nn.functional.pixel_shuffle(weight, stride)
    return weight.contiguous().numpy(), bias.numpy()


class GraphWriter:
    """Collects the nodes and constants of an ONNX graph; a node is named after what it gives."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: NDArray | float) -> str:
        """A float32 or int64 constant; the same name twice has to mean the same value."""
        array = np.ascontiguousarray(value)
        array = array if array.dtype == np.int64 else array.astype(np.float32)
        if all(known.name != name for known in self.constants):
            # ascontiguousarray makes a scalar one-dimensional.
            self.constants.append(numpy_helper.from_array(array.reshape(np.shape(value)), name))
        return name

    def node(self, operation: str, inputs: list[str], output: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(operation, inputs, [output], name=output, **attributes))
        return output

    def split(self, source: str, sizes: list[int], outputs: list[str], axis: int = 1) -> None:
        """Cut `source` along an axis."""
        lengths = self.constant(f"{source}.split", np.array(sizes, dtype=np.int64))
        self.nodes.append(helper.make_node("Split", [source, lengths], outputs, axis=axis))

    def linear(self, name: str, source: str, weight: Tensor, bias: Tensor) -> str:
        """A fully connected layer."""
        parameters = [
            self.constant(f"{name}.{part}", value.detach().numpy())
            for part, value in (("weight", weight), ("bias", bias))
        ]
        return self.node("Gemm", [source, *parameters], name, transB=1)

    def reshape(self, source: str, shape: tuple[int, ...], output: str) -> str:
        name = "shape." + "x".join(map(str, shape))
        return self.node("Reshape", [source, self.constant(name, np.array(shape, dtype=np.int64))], output)

    def block(self, name: str, source: str, weight: NDArray, bias: NDArray, stride: int, pooled: bool) -> str:
        """Convolution, ReLU and, if `pooled`, max-pooling (in the order that runtimes fuse)."""
        parameters = [self.constant(f"{name}.weight", weight), self.constant(f"{name}.bias", bias)]
        last = self.node(
            "Conv",
            [source, *parameters],
            f"{name}.conv",
            kernel_shape=[3 * stride, 3 * stride],
            pads=[stride] * 4,
            strides=[stride, stride],
        )
        last = self.node("Relu", [last], f"{name}.relu")
        if not pooled:
            return last
        return self.node("MaxPool", [last], f"{name}.pool", kernel_shape=[2, 2], strides=[2, 2])

    def softbound(self, source: str, output: str, bounds: tuple[float, ...]) -> str:
        """clamp(x) + (log1p(exp(-|x - lower|)) - log1p(exp(-|x - upper|))), held to its bounds."""
        low, high = (
            self.constant(f"softbound.{name}", value)
            for name, value in zip(("lower", "upper"), bounds, strict=True)
        )
        one = self.constant("one", 1.0)
        terms = []
        for name, bound in (("lower", low), ("upper", high)):
            prefix = f"{output}.{name}"
            last = self.node("Sub", [source, bound], f"{prefix}.difference")
            last = self.node("Abs", [last], f"{prefix}.distance")
            last = self.node("Neg", [last], f"{prefix}.exponent")
            last = self.node("Exp", [last], f"{prefix}.exp")
            last = self.node("Add", [last, one], f"{prefix}.sum")
            terms.append(self.node("Log", [last], f"{prefix}.log"))
        smooth = self.node("Sub", terms, f"{output}.correction")
        clamped = self.node("Clip", [source, low, high], f"{output}.clamp")
        total = self.node("Add", [clamped, smooth], f"{output}.total")
        return self.node("Clip", [total, low, high], output)

    def outer(self, left: str, right: str, output: str, size: int) -> str:
        """(N, K) and (N, K) -> (N, K, K)."""
        column = self.reshape(left, (-1, size, 1), f"{output}.column")
        row = self.reshape(right, (-1, 1, size), f"{output}.row")
        return self.node("Mul", [column, row], output)

    def diagonal(self, source: str, output: str, size: int) -> str:
        """(N, K) -> (N, K, K) with these on the diagonal."""
        row = self.reshape(source, (-1, 1, size), f"{output}.row")
        return self.node("Mul", [row, self.constant("identity", np.eye(size))], output)

    def chosen(self, source: str, kept: NDArray, others: NDArray, output: str) -> str:
        """`source` where `kept` is 1, `others` where it is 0."""
        masked = self.node("Mul", [source, self.constant(f"{output}.kept", kept)], f"{output}.masked")
        return self.node("Add", [masked, self.constant(f"{output}.prior", others)], output)

    def angle(self, sine: str, cosine: str, output: str) -> str:
        """atan2, which ONNX lacks: 2 atan of (r - c) / s or s / (r + c), whichever has no difference."""
        squares = [self.node("Mul", [part, part], f"{part}.squared") for part in (sine, cosine)]
        radius = self.node("Sqrt", [self.node("Add", squares, f"{output}.squared")], f"{output}.radius")
        length = self.node("Abs", [cosine], f"{output}.length")
        long = self.node("Add", [radius, length], f"{output}.long")
        front = self.node("Div", [sine, long], f"{output}.front")
        back = self.node("Div", [long, sine], f"{output}.back")
        ahead = self.node("Less", [self.constant("zero", 0.0), cosine], f"{output}.ahead")
        half = self.node("Where", [ahead, front, back], f"{output}.half.tangent")
        return self.node(
            "Mul", [self.node("Atan", [half], f"{output}.half"), self.constant("two", 2.0)], output
        )

    def model(self, channels: int, image_size: int, outputs: tuple[str, ...], size: int) -> onnx.ModelProto:
        """The whole model, with a free batch size, for so many quantities."""
        shape: list[str | int | None] = ["N", channels, image_size, image_size]
        source = helper.make_tensor_value_info(INPUT_NAME, TensorProto.FLOAT, shape)
        values = [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", *output_shapes(size)[name]])
            for name in outputs
        ]
        graph = helper.make_graph(self.nodes, "pose", [source], values, self.constants)
        return helper.make_model(
            graph,
            opset_imports=[helper.make_opsetid("", OPSET)],
            ir_version=IR_VERSION,
            producer_name="tactile_servoing",
        )


def write_head(graph: GraphWriter, raw: str, head: Head, sigma: NDArray[np.float64] | None) -> str:
    """From a head's raw outputs to `mu` and its uncertainty; returns the name of the latter's output."""
    kind, model = head.settings.head, head.model
    second = INVERSE_SIGMA if kind in ("mse", "gaussian") else COVARIANCE
    own = (f"{MEAN}.own", f"{second}.own") if model.unknown else (MEAN, second)
    if kind == "mse":
        if sigma is None:
            raise ValueError("a network with the head mse needs the standard deviations of its errors")
        _write_mean(graph, raw, head, own[0])
        nothing = graph.node("Mul", [own[0], graph.constant("zero", 0.0)], "nothing")
        graph.node("Add", [nothing, graph.constant("inverse_sigma.value", 1.0 / sigma)], own[1])
    elif kind == "gaussian":
        graph.split(raw, [head.means, model.size], ["mean.raw", "unbounded"])
        _write_mean(graph, "mean.raw", head, own[0])
        graph.softbound("unbounded", own[1], head.settings.inverse_sigma_bounds)
    elif isinstance(head, FullGaussianHead):
        _write_full(graph, raw, head, *own)
    else:
        _write_mixture(graph, raw, head, *own)
    if model.unknown:
        mean, deviation = model.prior
        known = model.known.astype(float)
        graph.chosen(own[0], known, (1.0 - known) * mean, MEAN)
        if second == COVARIANCE:
            known, others = np.outer(known, known), np.diag((1.0 - known) * deviation**2)
        else:
            others = (1.0 - known) / deviation
        graph.chosen(own[1], known, others, second)
    return second


def _write_mean(graph: GraphWriter, raw: str, head: Head, output: str) -> None:
    """Means (N, K) of what tells them (N, means): all as it is but for angles that go all round."""
    turning = head.model.turning
    if not turning:
        graph.node("Identity", [raw], output)
        return
    parts = [f"{output}.{k}" for k in range(head.means)]
    graph.split(raw, [1] * head.means, parts)
    for place, k in enumerate(turning):
        parts[k] = graph.angle(parts[k], parts[head.model.size + place], f"{output}.angle{k}")
    graph.node("Concat", parts[: head.model.size], output, axis=1)


def _write_full(graph: GraphWriter, raw: str, head: FullGaussianHead, mean: str, covariance: str) -> None:
    """Covariance D (I + L)^-1 (I + L)^-T D; the inverse is (I - L) (I + L^2) (I + L^4) .. since L^K = 0."""
    size = head.model.size
    graph.split(raw, [head.means, size, len(head.lower)], ["mean.raw", "unbounded", "lower.values"])
    _write_mean(graph, "mean.raw", head, mean)
    inverse_sigma = graph.softbound("unbounded", "conditional", head.settings.inverse_sigma_bounds)
    places = np.zeros((len(head.lower), size * size))
    for index, (row, column) in enumerate(head.lower):
        places[index, row * size + column] = head.model.known[row] and head.model.known[column]
    flat = graph.node("MatMul", ["lower.values", graph.constant("lower.places", places)], "lower.flat")
    power = graph.reshape(flat, (-1, size, size), "lower")
    identity = graph.constant("identity", np.eye(size))
    first, exponent = graph.node("Sub", [identity, power], "inverse.1"), 2
    while exponent < size:
        power = graph.node("MatMul", [power, power], f"lower.{exponent}")
        factor = graph.node("Add", [identity, power], f"inverse.{exponent}.factor")
        first = graph.node("MatMul", [first, factor], f"inverse.{exponent}")
        exponent *= 2
    scale = graph.reshape(inverse_sigma, (-1, size, 1), "conditional.column")
    root = graph.node("Div", [first, scale], "root")
    transposed = graph.node("Transpose", [root], "root.transposed", perm=[0, 2, 1])
    graph.node("MatMul", [root, transposed], covariance)


def _write_mixture(graph: GraphWriter, raw: str, head: Head, mean: str, covariance: str) -> None:
    """Mean and covariance of the two Gaussians' mixture."""
    size, bounds = head.model.size, head.settings.inverse_sigma_bounds
    names = [f"{part}{k}" for k in range(COMPONENTS_OF_MIXTURE) for part in ("mean", "unbounded")]
    graph.split(raw, [size] * len(names) + [1], [*names, "logit"])
    negative = graph.node("Neg", ["logit"], "logit.negative")
    weights = [graph.node("Sigmoid", [logit], f"weight{k}") for k, logit in enumerate(("logit", negative))]
    means, variances = [], []
    for k, weight in enumerate(weights):
        inverse_sigma = graph.softbound(f"unbounded{k}", f"inverse_sigma{k}", bounds)
        squared = graph.node("Mul", [inverse_sigma, inverse_sigma], f"precision{k}")
        variances.append(graph.node("Div", [weight, squared], f"variance{k}"))
        means.append(graph.node("Mul", [weight, f"mean{k}"], f"weighted_mean{k}"))
    graph.node("Add", means, mean)
    within = graph.diagonal(graph.node("Add", variances, "variance"), "within", size)
    difference = graph.node("Sub", ["mean0", "mean1"], "difference")
    product = graph.node("Mul", weights, "weights")
    scaled = graph.node("Mul", [difference, product], "scaled_difference")
    between = graph.outer(scaled, difference, "between", size)
    graph.node("Add", [within, between], covariance)
