"""Export of a trained network to ONNX: batch normalization folded, dropout gone, metadata inside."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper
from torch import nn

from tactile_base.whole_file import whole_file
from tactile_perception.estimating.model_metadata import INPUT_NAME, MEAN, ModelMetadata
from tactile_perception.training.graph_writer import GraphWriter, write_head
from tactile_perception.training.network import ConvBlock, PoseNetwork


def export_onnx(
    network: PoseNetwork, path: Path | str, metadata: ModelMetadata, sigma: NDArray[np.float64] | None = None
) -> Path:
    """Write `network` as it answers in evaluation mode.

    The graph is written node by node rather than traced: it stays the same for every PyTorch version, and
    its names are readable. Input `image` float32 (N, 1, size, size) in [0, 1]; outputs float32, in mm and
    rad: `mu` (N, 6), and `inverse_sigma` (N, 6) or `covariance` (N, 6, 6).

    Parameters
    ----------
    sigma : (6,), needed by a network without uncertainty of its own (head mse)
        The standard deviations in mm and rad that its file then states for every image.
    """
    settings = network.settings
    graph = GraphWriter()
    last = INPUT_NAME
    for index, block in enumerate(network.base):
        assert isinstance(block, ConvBlock)
        stride = settings.first_stride if index == 0 else 1
        last = graph.block(f"block{index + 1}", last, *_folded(block, stride), stride, block.pooled)
    last = graph.node("Flatten", [last], "features", axis=1)
    head = network.head
    weight = graph.constant("head.weight", (head.gain * head.weight.detach()).numpy())
    bias = graph.constant("head.bias", head.bias.detach().numpy())
    last = graph.node("Gemm", [last, weight, bias], "head", transB=1)
    second = write_head(graph, last, settings, sigma)
    model = graph.model(settings.image_size, (MEAN, second))
    helper.set_model_props(model, metadata.to_properties())
    onnx.checker.check_model(model)
    with whole_file(path) as temporary:
        onnx.save_model(model, str(temporary))
    return Path(path)


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
