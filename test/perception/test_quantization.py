"""Quantization: nearly the same answers from a smaller, faster model; errors for what cannot be quantized."""

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="quantization needs onnx (the extra 'train')")
torch = pytest.importorskip("torch", reason="making a network needs PyTorch (the extra 'train')")

from tactile_base.settings import SettingError  # noqa: E402
from tactile_bringup.cli import main as tactile  # noqa: E402
from tactile_perception.estimating.estimator import Estimator  # noqa: E402
from tactile_perception.estimating.preprocessing import as_input  # noqa: E402
from tactile_perception.training.export import export_onnx  # noqa: E402
from tactile_perception.training.network import PoseNetwork  # noqa: E402
from tactile_perception.training.quantization import (  # noqa: E402
    QuantizationError,
    QuantizationSettings,
    quantize,
)
from tactile_perception.training.settings import NetworkSettings  # noqa: E402


def images(count: int, side: int, seed: int = 0) -> np.ndarray:
    """Images of blobs (N, side, side)."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:side, :side]
    result = np.zeros((count, side, side), np.uint8)
    for image in result:
        for x, y, radius in rng.uniform([0, 0, 2], [side, side, 5], (20, 3)):
            image[np.hypot(columns - x, rows - y) < radius] = 255
    return result


@pytest.fixture(params=[(1, 0), (2, 0), (1, 1)], ids=["stride 1", "stride 2", "last block unpooled"])
def model(request, tmp_path, model_metadata) -> Path:
    """An untrained network whose answers depend on the image."""
    torch.manual_seed(0)
    stride, unpooled = request.param
    settings = NetworkSettings(
        image_size=64, first_stride=stride, channels=(8, 16, 64, 64), unpooled_blocks=unpooled, head_gain=1.0
    )
    network = PoseNetwork(settings)
    torch.nn.init.normal_(network.head.weight, std=0.05)
    network.head.bias.data[6:] = 1.0
    return export_onnx(network.eval(), tmp_path / "model.onnx", model_metadata(size=64))


def predictions(path: Path, stack: np.ndarray) -> np.ndarray:
    estimator = Estimator(path)
    mean, covariance = estimator.predict(as_input(stack))
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    return np.concatenate([mean, 1.0 / sigma], axis=1)


@pytest.mark.parametrize("reduce_range", [True, False])
def test_answers_stay_nearly_the_same(model, tmp_path, reduce_range):
    out = quantize(
        model, images(40, 64), tmp_path / "q.onnx", QuantizationSettings(reduce_range=reduce_range)
    )
    unseen = images(50, 64, seed=1)
    exact, quantized = predictions(model, unseen), predictions(out, unseen)
    difference = np.sqrt(((quantized - exact) ** 2).mean(axis=0))
    assert np.all(difference < 0.1 * exact.std(axis=0))
    assert np.any(quantized != exact)


def test_the_file_is_smaller_and_tells_that_it_is_quantized(model, tmp_path):
    out = quantize(model, images(7, 64), tmp_path / "q.onnx")
    before, after = Estimator(model).metadata, Estimator(out).metadata
    assert out.stat().st_size < 0.75 * model.stat().st_size
    assert after.preprocessing == before.preprocessing
    assert after.training_data == before.training_data
    assert after.training["quantization"]["images"] == 7
    assert after.training["quantization"]["weights"] == "int8"
    assert {k: v for k, v in after.training.items() if k != "quantization"} == before.training


def test_only_the_first_block_computes_in_float(model, tmp_path):
    graph = onnx.load_model(str(quantize(model, images(7, 64), tmp_path / "q.onnx"))).graph
    producers = {output: node.op_type for node in graph.node for output in node.output}
    weights = [producers.get(node.input[1], "float") for node in graph.node if node.op_type == "Conv"]
    assert weights == ["float"] + 3 * ["DequantizeLinear"]


def test_no_answer_is_off_on_average(model, tmp_path):
    seen = images(100, 64)
    out = quantize(model, seen, tmp_path / "q.onnx")
    for stack, tolerance in ((seen, 1e-4), (images(400, 64, seed=1), 0.03)):
        exact, quantized = predictions(model, stack)[:, :6], predictions(out, stack)[:, :6]
        spread = exact.std(axis=0)
        assert np.all(np.abs((quantized - exact).mean(axis=0)) < tolerance * spread)
        slope = ((exact - exact.mean(axis=0)) * (quantized - exact)).mean(axis=0) / spread**2
        assert np.all(np.abs(slope) < 0.03)


def test_the_same_images_give_the_same_model(model, tmp_path):
    first = quantize(model, images(7, 64), tmp_path / "a.onnx").read_bytes()
    assert quantize(model, images(7, 64), tmp_path / "b.onnx").read_bytes() == first


def test_what_cannot_be_quantized_is_refused(model, tmp_path, constant_model):
    out = tmp_path / "q.onnx"
    with pytest.raises(QuantizationError, match="there is no such model file"):
        quantize(tmp_path / "none.onnx", images(1, 64), out)
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(QuantizationError, match="is not a readable ONNX model"):
        quantize(tmp_path / "text.onnx", images(1, 64), out)
    with pytest.raises(QuantizationError, match=r"image goes into ReduceMean, must go into one Conv"):
        quantize(constant_model(), images(1, 128), out)
    with pytest.raises(QuantizationError, match=r"must be uint8 of the shape \(N, 64, 64\)"):
        quantize(model, images(1, 32), out)
    with pytest.raises(QuantizationError, match=r"\(N, 64, 64\)"):
        quantize(model, images(0, 64), out)
    with pytest.raises(QuantizationError, match="is quantized already"):
        quantize(quantize(model, images(1, 64), out), images(1, 64), tmp_path / "r.onnx")
    with pytest.raises(SettingError, match="images"):
        QuantizationSettings(images=0)


def test_command_writes_the_model_and_compares_both(model, tmp_path, training_data, capsys):
    installed = tmp_path / "installed.onnx"
    arguments = ["quantize", str(model), "--data", str(training_data), "--install", str(installed)]
    assert tactile([*arguments, "--set", "images=11"]) == 0
    written = tmp_path / "model_int8.onnx"
    assert installed.read_bytes() == written.read_bytes()
    assert Estimator(written).metadata.training["quantization"]["images"] == 11
    output = capsys.readouterr().out
    for text in ("model.onnx", "model_int8.onnx", "MB", "p99", "rho_x", "phi_z"):
        assert text in output
    first = written.read_bytes()
    assert tactile([*arguments, "--set", "images=5"]) == 0
    assert (tmp_path / "model_int8-1.onnx").read_bytes() == first != written.read_bytes()


def test_command_tells_what_is_wrong(model, tmp_path, training_data, capsys):
    assert tactile(["quantize", str(tmp_path / "none"), "--data", str(training_data)]) == 1
    assert "no such model" in capsys.readouterr().err
    assert tactile(["quantize", str(model), "--data", str(tmp_path / "none")]) == 1
    assert str(tmp_path / "none") in capsys.readouterr().err
    assert tactile(["quantize", str(model), "--data", str(training_data), "--out", str(model)]) == 1
    assert "is the model itself" in capsys.readouterr().err
    assert tactile(["quantize", str(model), "--data", str(training_data), "--set", "image=3"]) == 1
    assert "did you mean 'images'" in capsys.readouterr().err
