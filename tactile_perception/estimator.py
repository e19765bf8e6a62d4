"""The estimator: a trained model on onnxruntime that turns an image into a Gaussian over X_sf."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from tactile_filter import se3
from tactile_filter.gaussian import PoseGaussian
from tactile_filter.settings import Settings, setting
from tactile_perception.labels import NETWORK_SCALE, pose_from_network
from tactile_perception.model_metadata import INPUT_NAME, OUTPUT_NAMES, MetadataError, ModelMetadata
from tactile_perception.preprocessing import Image, Preprocessor

Array = NDArray[np.float64]
_WARM_UP_RUNS = 5


class ModelError(ValueError):
    """A model file that is missing, is no model, or is not one that this estimator can use."""


class EstimateError(ValueError):
    """An answer of the network that is not a Gaussian (NaN, infinite, or without a positive 1/sigma)."""


@dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Which model, and on how many cores."""

    model: str = setting("", doc="path of the ONNX model; empty: the shipped model of the simulated TacTip")
    threads: int = setting(1, lower=1, upper=64, doc="CPU threads of one inference")


@dataclass(frozen=True)
class StageTimes:
    """Seconds that each stage of the last estimate took."""

    preprocess: float = 0.0
    infer: float = 0.0
    convert: float = 0.0

    @property
    def total(self) -> float:
        return self.preprocess + self.infer + self.convert


def shipped_model() -> Path:
    """Path of the model that comes with the package, trained on the simulated TacTip."""
    return Path(__file__).parent / "models" / "tactip_sim.onnx"


class Estimator:
    """Image -> left-perturbation Gaussian over X_sf (SI). Not thread-safe: one per thread.

    Attributes
    ----------
    metadata : ModelMetadata
        What the model file says about itself.
    preprocessor : Preprocessor
        Made from the settings in the metadata, so that images are prepared as they were in training.
    times : StageTimes
        Of the last estimate.
    """

    def __init__(self, model_path: Path | str = "", threads: int = 1) -> None:
        """Load and check a model, and run it a few times so that the first real image is not slow.

        Raises
        ------
        ModelError
            Saying which file, what is wrong with it, and what would be right.
        """
        self.path = Path(model_path) if str(model_path) else shipped_model()
        self._session = _open_session(self.path, threads)
        try:
            self.metadata = ModelMetadata.from_properties(self._session.get_modelmeta().custom_metadata_map)
        except MetadataError as error:
            raise ModelError(f"{self.path}: {error}") from error
        side = self.metadata.preprocessing.size
        _check_tensors(self.path, "input", self._session.get_inputs(), {INPUT_NAME: (1, side, side)})
        _check_tensors(self.path, "output", self._session.get_outputs(), dict.fromkeys(OUTPUT_NAMES, (6,)))
        self.preprocessor = Preprocessor(self.metadata.preprocessing)
        self.times = StageTimes()
        self.warm_up()

    def estimate(self, image: Image) -> PoseGaussian:
        """Camera image, uint8 (480, 640) unless the model's settings say otherwise -> Gaussian over X_sf.

        Raises
        ------
        ImageError
            If the image has the wrong size or type.
        EstimateError
            If the network's answer is not a Gaussian.
        """
        started = time.perf_counter()
        prepared = self.preprocessor(image)
        return self._estimate(prepared, time.perf_counter() - started)

    def estimate_processed(self, crop: Image) -> PoseGaussian:
        """The same for an image that is already cropped and thresholded (`processed_images/`)."""
        started = time.perf_counter()
        prepared = self.preprocessor.from_processed(crop)
        return self._estimate(prepared, time.perf_counter() - started)

    def estimate_prepared(self, prepared: NDArray[np.float32]) -> PoseGaussian:
        """The same for the preprocessor's output (1, 1, size, size), where that is needed elsewhere too."""
        return self._estimate(prepared, 0.0)

    def infer(self, prepared: NDArray[np.float32]) -> tuple[Array, Array]:
        """Mean xi_sf (6,) and inverse standard deviations (6,), in mm and rad, of a prepared image."""
        mean, inverse_sigma = self._session.run(OUTPUT_NAMES, {INPUT_NAME: prepared})
        return mean[0].astype(np.float64), inverse_sigma[0].astype(np.float64)

    def warm_up(self, runs: int = _WARM_UP_RUNS) -> None:
        """Run black images through all stages; the first runs allocate memory."""
        black = np.zeros(self.metadata.preprocessing.raw_shape, np.uint8)
        for _ in range(runs):
            self.infer(self.preprocessor(black))

    def _estimate(self, prepared: NDArray[np.float32], preprocess: float) -> PoseGaussian:
        started = time.perf_counter()
        mean, inverse_sigma = self.infer(prepared)
        inferred = time.perf_counter()
        gaussian = pose_gaussian(mean, inverse_sigma)
        self.times = StageTimes(preprocess, inferred - started, time.perf_counter() - inferred)
        return gaussian


def pose_gaussian(mean: Array, inverse_sigma: Array) -> PoseGaussian:
    """Network answer -> X_sf = exp(eps^) exp(mean^), eps ~ N(0, J(mean) Sigma J(mean)^T), in SI.

    Paper, eq. left_perturbation_cov: the network's diagonal Gaussian lives around its mean in the global
    tangent space; the left Jacobian carries it to the perturbation on the left of the mean.

    Parameters
    ----------
    mean, inverse_sigma : (6,) xi_sf and inverse standard deviations, in mm and rad.

    Raises
    ------
    EstimateError
    """
    if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(inverse_sigma))):
        raise EstimateError(f"the network answered with NaN or infinity: mu {mean}, 1/sigma {inverse_sigma}")
    if not np.all(inverse_sigma > 0.0):
        raise EstimateError(f"the network answered with 1/sigma that is not positive: {inverse_sigma}")
    jacobian = se3.left_jacobian(mean * NETWORK_SCALE)
    root = jacobian * (NETWORK_SCALE / inverse_sigma)
    return PoseGaussian(pose_from_network(mean), root @ root.T)


def _open_session(path: Path, threads: int) -> onnxruntime.InferenceSession:
    if not path.is_file():
        hint = " (`make model` trains it)" if path == shipped_model() else ""
        raise ModelError(f"{path}: there is no such model file{hint}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Waiting threads that spin would take the cores from the other nodes.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base class of their own
        raise ModelError(f"{path}: is not a usable ONNX model: {error}") from error


def _check_tensors(path: Path, kind: str, tensors: list, expected: dict[str, tuple[int, ...]]) -> None:
    """`ModelError` unless the tensors have these names and, after the batch axis, these shapes."""
    right = ", ".join(f"{name} float32 (N, {', '.join(map(str, shape))})" for name, shape in expected.items())
    found = {tensor.name: (tensor.type, tuple(tensor.shape)) for tensor in tensors}
    matches = found.keys() == expected.keys() and all(
        kind_of == "tensor(float)" and shape[1:] == expected[name] and len(shape) == len(expected[name]) + 1
        for name, (kind_of, shape) in found.items()
    )
    if not matches:
        listed = ", ".join(f"{name} {kind_of} {shape}" for name, (kind_of, shape) in found.items())
        raise ModelError(f"{path}: has the {kind}s {listed}; must have {right}")
