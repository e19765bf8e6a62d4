"""Fixtures shared by the tests of perception."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from folders import dot_image, write_folder

from tactile_perception.estimating.model_metadata import FRAMES, ModelMetadata, summed
from tactile_perception.estimating.preprocessing import PreprocessingSettings


@pytest.fixture
def model_metadata() -> Callable[..., ModelMetadata]:
    """Makes the metadata of a model; arguments are pre-processing settings."""

    def make(**preprocessing) -> ModelMetadata:
        return ModelMetadata(
            preprocessing=PreprocessingSettings(**preprocessing),
            training_data={"samples": 1, "sha256": "0" * 64},
            validation={"mean_nll": 0.0},
            frames=FRAMES,
        )

    return make


@pytest.fixture
def constant_model(tmp_path: Path, model_metadata) -> Callable[..., Path]:
    """Writes an ONNX model that gives the same answer to every image; arguments make it wrong in one way."""
    onnx = pytest.importorskip("onnx", reason="building a model file needs onnx (the extra 'train')")

    def write(
        mu=(0.0,) * 6, inverse_sigma=(1.0,) * 6, side: int = 128, properties: dict[str, str] | None = None,
        input_name: str = "image",
    ) -> Path:  # fmt: skip
        helper, kind = onnx.helper, onnx.TensorProto.FLOAT
        answers = {"mu": np.float32([mu]), "inverse_sigma": np.float32([inverse_sigma])}
        nodes = [
            helper.make_node("ReduceMean", [input_name], ["mean"], axes=[2, 3], keepdims=0),
            helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
            *(helper.make_node("Add", ["nothing", f"{name}_value"], [name]) for name in answers),
        ]
        constants = [onnx.numpy_helper.from_array(np.float32([[0.0]]), "zero")]
        constants += [onnx.numpy_helper.from_array(value, f"{name}_value") for name, value in answers.items()]
        image = helper.make_tensor_value_info(input_name, kind, ["N", 1, side, side])
        outputs = [
            helper.make_tensor_value_info(name, kind, ["N", value.size]) for name, value in answers.items()
        ]
        graph = helper.make_graph(nodes, "constant", [image], outputs, constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
        helper.set_model_props(model, model_metadata().to_properties() if properties is None else properties)
        path = tmp_path / "constant.onnx"
        path.write_bytes(summed(model.SerializeToString()))
        return path

    return write


@pytest.fixture(scope="session")
def dots() -> Callable[..., np.ndarray]:
    """`dot_image`, for tests that need new images of the kind in `training_data`."""
    return dot_image


@pytest.fixture(scope="session")
def training_data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with 96 training and 32 validation samples of `dot_image`."""
    folder = tmp_path_factory.mktemp("training_data")
    rng = np.random.default_rng(0)
    for name, count in (("train", 96), ("val", 32)):
        eulers = (rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1]) for _ in range(count))
        write_folder(folder / name, ((dot_image(euler, rng), euler) for euler in eulers))
    return folder
