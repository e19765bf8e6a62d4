"""Quantization of a trained network to 8-bit integers: the same network in less than half the time.

The graph is in the QDQ form of onnxruntime: activations in 8 bits with ranges measured on calibration images,
weights in 8 bits with a scale for each output channel. The first block, whose single input channel makes
integers slow, and the last layer, which needs the range, stay in float.
"""

from __future__ import annotations

import json
import logging
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from numpy.typing import NDArray
from onnx import numpy_helper
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

from tactile_base.settings import Settings, setting
from tactile_base.whole_file import whole_file
from tactile_perception.datasets.dataset import read_dataset, training_part
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.layout import Layout
from tactile_perception.estimating.model_metadata import (
    CHECKSUM,
    INPUT_NAME,
    LAYOUT,
    REFERENCE,
    UNSUMMED,
    MetadataError,
    ModelMetadata,
    summed,
)
from tactile_perception.estimating.preprocessing import as_input

_BATCH = 20
_OPERATIONS = ["Conv", "Relu", "MaxPool"]
#: Entries of the metadata that onnxruntime's tools leave behind.
_LEFT_BEHIND = ("onnx.infer", "onnx.quant.pre_process")


class QuantizationError(ValueError):
    """A model that cannot be quantized, or images that do not fit it."""


@dataclass(frozen=True)
class QuantizationSettings(Settings):
    """How a network is quantized."""

    images: int = setting(
        200, lower=1, upper=100_000,
        doc="training images, spread over the table, that give the activations' ranges",
    )  # fmt: skip
    reduce_range: bool = setting(
        True,
        doc="weights in 7 of 8 bits: CPUs without VNNI add products in pairs, which 8 bits may overflow",
    )


def training_images(folder: Path, model: Path, count: int) -> NDArray[np.uint8]:
    """`count` images, spread over the folder's table, prepared as the model wants them: (N, size, size[, 3]).

    Fewer where the folder has fewer or some of these cannot be read.
    """
    preprocessing = Estimator(model).metadata.preprocessing
    return read_dataset(training_part(folder), preprocessing, limit=count, complete=False).images


def quantize(
    model_path: Path | str,
    images: NDArray[np.uint8],
    out_path: Path | str,
    settings: QuantizationSettings | None = None,
) -> Path:
    """Write the model at `model_path` in 8-bit integers to `out_path`.

    `QuantizationError` says which file or images, what is wrong, and what would be right.

    The images (N, size, size) are prepared (`Preprocessor.resized`), such as the network was trained on.
    """
    settings = settings or QuantizationSettings()
    model = _load(Path(model_path))
    wanted = _metadata(model, Path(model_path)).preprocessing
    shape = (wanted.size, wanted.size, 3)[: 2 + wanted.color]
    if images.shape[1:] != shape or images.dtype != np.uint8 or not len(images):
        raise QuantizationError(
            f"calibration images: must be uint8 of the shape (N, {', '.join(map(str, shape))}), "
            f"are {images.dtype} of {images.shape}"
        )
    first = _first_block(model, Path(model_path))
    _check_head(model, Path(model_path))
    _pool_before_relu(model, first)
    with tempfile.TemporaryDirectory() as folder, _without_advice():
        prepared, quantized = Path(folder) / "prepared.onnx", Path(folder) / "quantized.onnx"
        onnx.save_model(model, str(prepared))
        quantize_static(
            str(prepared),
            str(quantized),
            _Images(images),
            per_channel=True,
            reduce_range=settings.reduce_range,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            op_types_to_quantize=_OPERATIONS,
            nodes_to_exclude=[node.name for node in first],
        )
        result = onnx.load_model(str(quantized))
    _correct_head(result, model, images)
    _note(result, settings, images)
    with whole_file(out_path) as temporary:
        temporary.write_bytes(summed(result.SerializeToString()))
    return Path(out_path)


class _Images(CalibrationDataReader):
    """Hands prepared images to the calibration, a few at a time."""

    def __init__(self, images: NDArray[np.uint8]) -> None:
        self._batches = (images[start : start + _BATCH] for start in range(0, len(images), _BATCH))

    def get_next(self) -> dict[str, NDArray[np.float32]] | None:
        batch = next(self._batches, None)
        return None if batch is None else {INPUT_NAME: as_input(batch)}


def _load(path: Path) -> onnx.ModelProto:
    if not path.is_file():
        raise QuantizationError(f"{path}: there is no such model file")
    try:
        return onnx.load_model(str(path))
    except Exception as error:  # protobuf's and onnx's exceptions share no base class of their own
        raise QuantizationError(f"{path}: is not a readable ONNX model: {error}") from error


def _metadata(model: onnx.ModelProto, path: Path) -> ModelMetadata:
    if any(node.op_type == "QuantizeLinear" for node in model.graph.node):
        raise QuantizationError(f"{path}: is quantized already")
    try:
        return ModelMetadata.from_properties({entry.key: entry.value for entry in model.metadata_props})
    except MetadataError as error:
        raise QuantizationError(f"{path}: {error}") from error


def _first_block(model: onnx.ModelProto, path: Path) -> tuple[onnx.NodeProto, ...]:
    """Convolution, ReLU and max-pooling that the image goes through first."""
    block, source = [], INPUT_NAME
    for operation in ("Conv", "Relu", "MaxPool"):
        users = [node for node in model.graph.node if source in node.input]
        if len(users) != 1 or users[0].op_type != operation:
            found = ", ".join(node.op_type for node in users) or "nothing"
            raise QuantizationError(f"{path}: {source} goes into {found}, must go into one {operation}")
        block.append(users[0])
        source = users[0].output[0]
    return tuple(block)


def _check_head(model: onnx.ModelProto, path: Path) -> None:
    """`QuantizationError` unless there is one last layer, of weights and a bias that are constants."""
    layers = [node for node in model.graph.node if node.op_type == "Gemm"]
    constants = {constant.name for constant in model.graph.initializer}
    usable = [node for node in layers if len(node.input) == 3 and set(node.input[1:]) <= constants]
    if len(layers) != 1 or not usable or {a.name: a.i for a in layers[0].attribute}.get("transB") != 1:
        raise QuantizationError(
            f"{path}: has {len(layers)} fully connected layers (Gemm), must have one, with constant "
            "(transposed) weights and bias"
        )


def _pool_before_relu(model: onnx.ModelProto, block: tuple[onnx.NodeProto, ...]) -> None:
    """Swap ReLU and max-pooling, which commute.

    Otherwise onnxruntime quantizes before the pooling, where four times as many values lie in an order that
    its pooling of integers is slow with.
    """
    convolution, relu, pool = block
    last = pool.output[0]
    pool.input[0], pool.output[0] = convolution.output[0], f"{pool.name}.before_relu"
    relu.input[0], relu.output[0] = pool.output[0], last
    nodes = [node for node in model.graph.node if node.name != pool.name]
    nodes.insert(nodes.index(relu), pool)
    ordered = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
    del model.graph.node[:]
    model.graph.node.extend(ordered)


def _correct_head(quantized: onnx.ModelProto, exact: onnx.ModelProto, images: NDArray[np.uint8]) -> None:
    """Give the last layer the weights and bias with which its outputs fit the exact ones best.

    Most of what quantization does to an output is an offset and a factor: activations are rounded and cut off
    in the same sense, image after image. Both are taken back by the regression of the exact outputs on the
    quantized ones over the calibration images.
    """
    wanted, found = _head_outputs(exact, images), _head_outputs(quantized, images)
    deviation = found - found.mean(axis=0)
    power = (deviation**2).mean(axis=0)
    factor = np.ones(found.shape[1])
    varies = power > (1e-6 * np.abs(found).max(axis=0)) ** 2
    factor[varies] = ((deviation * wanted).mean(axis=0) / np.where(varies, power, 1.0))[varies]
    offset = wanted.mean(axis=0) - factor * found.mean(axis=0)
    head = _head(quantized)
    constants = {constant.name: constant for constant in quantized.graph.initializer}
    weight, bias = (numpy_helper.to_array(constants[name]).astype(np.float64) for name in head.input[1:3])
    corrected = (factor[:, None] * weight, factor * bias + offset)
    for name, value in zip(head.input[1:3], corrected, strict=True):
        constants[name].CopyFrom(numpy_helper.from_array(value.astype(np.float32), name))


def _head(model: onnx.ModelProto) -> onnx.NodeProto:
    return next(node for node in model.graph.node if node.op_type == "Gemm")


def _head_outputs(model: onnx.ModelProto, images: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Raw outputs (N, outputs) of the last layer."""
    name = _head(model).output[0]
    probe = onnx.ModelProto.FromString(model.SerializeToString())
    probe.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    session = onnxruntime.InferenceSession(probe.SerializeToString(), providers=["CPUExecutionProvider"])
    parts = [
        session.run([name], {INPUT_NAME: as_input(images[start : start + _BATCH])})[0]
        for start in range(0, len(images), _BATCH)
    ]
    return np.concatenate(parts).astype(np.float64)


def _note(model: onnx.ModelProto, settings: QuantizationSettings, images: NDArray[np.uint8]) -> None:
    """Tell in the metadata, beside the settings of the training, that and how the network was quantized.

    A model that was trained before there was a layout gets that of these images.
    """
    properties = {entry.key: entry.value for entry in model.metadata_props if entry.key not in _LEFT_BEHIND}
    training: dict[str, Any] = json.loads(properties.get("training", "{}"))
    types = {"activations": "uint8", "weights": "int8"}
    training["quantization"] = {**asdict(settings), "images": len(images), **types}
    properties["training"] = json.dumps(training)
    if REFERENCE not in properties:  # differences to an image show no layout
        properties.setdefault(LAYOUT, Layout.of(images).to_text())
    properties[CHECKSUM] = UNSUMMED
    del model.metadata_props[:]
    onnx.helper.set_model_props(model, properties)
    model.producer_name = "tactile_servoing"


@contextmanager
def _without_advice() -> Iterator[None]:
    """No advice of onnxruntime's tools on the log: what they advise has no effect on these graphs."""
    logger = logging.getLogger()
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
