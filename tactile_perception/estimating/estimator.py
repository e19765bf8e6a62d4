"""The estimator: a trained model on onnxruntime that turns an image into a Gaussian over X_sf."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from tactile_base.settings import Settings, setting
from tactile_filter.force import ForceGaussian
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.estimating.image import Image, ImageError
from tactile_perception.estimating.labels import EstimateError, gaussian_from_root, pose_gaussian
from tactile_perception.estimating.model_metadata import (
    COVARIANCE,
    INPUT_NAME,
    INVERSE_SIGMA,
    MEAN,
    RUN_MODELS,
    MetadataError,
    ModelMetadata,
    check_sum,
    output_shapes,
)
from tactile_perception.estimating.preprocessing import Preprocessor

Array = NDArray[np.float64]
_WARM_UP_RUNS = 5
_UNSUMMED = (
    "has no checksum, so that damage to its weights would not show; `tactile train`, `tactile calibrate` and "
    "`tactile quantize` write one"
)


class ModelError(ValueError):
    """A model file that is missing, is no model, or is not one that this estimator can use."""


@dataclass(frozen=True)
class EstimatorSettings(Settings):
    """Which model, and on how many cores."""

    model: str = setting(
        "",
        doc="path of an ONNX model, or of a run folder of `tactile train`, of which the quantized model is "
        "taken if there is one; empty: the shipped model of the simulated TacTip",
    )
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
    return Path(__file__).parents[1] / "models" / "tactip_sim.onnx"


class Estimator:
    """Image -> left-perturbation Gaussian over X_sf (SI). Not thread-safe: one per thread.

    Attributes
    ----------
    metadata : what the model file says about itself
    preprocessor : Preprocessor
        Made from the settings in the metadata, so that images are prepared as they were in training.
    times : of the last estimate
    force : ForceGaussian or None
        What the last estimate says of the force on the sensor; None where the model does not tell it.
    """

    def __init__(self, model_path: Path | str = "", threads: int = 1) -> None:
        """Load and check a model, and run it a few times so that the first real image is not slow.

        `ModelError` says which file, what is wrong with it, and what would be right.
        """
        self.path = _model_file(Path(model_path)) if str(model_path) else shipped_model()
        self._session = _open_session(self.path, threads)
        try:
            self.metadata = ModelMetadata.from_properties(self._session.get_modelmeta().custom_metadata_map)
        except (MetadataError, UnicodeDecodeError) as error:
            raise ModelError(f"{self.path}: {error}") from error
        settings, shapes = self.metadata.preprocessing, output_shapes(self.metadata.contact_model.size)
        side, channels = settings.size, settings.channels
        _check_tensors(self.path, "input", self._session.get_inputs(), {INPUT_NAME: (channels, side, side)})
        outputs = self._session.get_outputs()
        #: The second output: of standard deviations, or a whole covariance.
        self._uncertainty = next((o.name for o in outputs if o.name == COVARIANCE), INVERSE_SIGMA)
        self._outputs = [MEAN, self._uncertainty]
        _check_tensors(self.path, "output", outputs, {name: shapes[name] for name in self._outputs})
        self._one = _OneImage(
            self._session, (channels, side, side), {name: shapes[name] for name in self._outputs}
        )
        model = self.metadata.contact_model
        self._pose_alone = model.tangent and not model.forces
        self.force: ForceGaussian | None = None
        self.preprocessor = Preprocessor(settings, self.metadata.reference)
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
        return self._estimate(image, self.preprocessor)

    def estimate_processed(self, crop: Image) -> PoseGaussian:
        """`estimate` of an image of `processed_images/`."""
        return self._estimate(crop, self.preprocessor.from_processed)

    def estimate_prepared(self, prepared: NDArray[np.float32]) -> PoseGaussian:
        """`estimate` of the preprocessor's output, where that is needed elsewhere too."""
        return self._estimate(prepared, None)

    def predict(self, prepared: NDArray[np.float32]) -> tuple[Array, Array]:
        """Many prepared images (N, channels, size, size) -> mean (N, K), calibrated covariance (N, K, K).

        Of what the contact model tells (xi_sf), in mm, rad and N, unchecked: for evaluation.
        """
        mean, covariance = self.predict_uncalibrated(prepared)
        return mean, self.metadata.calibration.covariance(mean, covariance)

    def predict_uncalibrated(self, prepared: NDArray[np.float32]) -> tuple[Array, Array]:
        """`predict` without the calibration in the model file: as the network says it."""
        mean, uncertainty = self._session.run(self._outputs, {INPUT_NAME: prepared})
        return mean.astype(np.float64), _covariances(uncertainty.astype(np.float64))

    def warm_up(self, runs: int = _WARM_UP_RUNS) -> None:
        """Run black images through all stages; the first runs allocate memory."""
        settings = self.metadata.preprocessing
        black = np.zeros((*settings.raw_shape, settings.channels), np.uint8)
        for _ in range(runs):
            self._one.run(self.preprocessor(black))

    def _estimate(
        self, image: NDArray, prepare: Callable[[Image], NDArray[np.float32]] | None
    ) -> PoseGaussian:
        started = prepared = time.perf_counter()
        if prepare is not None:
            image = prepare(image)
            prepared = time.perf_counter()
        mean, uncertainty = self._one.run(image)
        inferred = time.perf_counter()
        gaussian = self._gaussian(mean, uncertainty)
        self.times = StageTimes(prepared - started, inferred - prepared, time.perf_counter() - inferred)
        return gaussian

    def _gaussian(self, mean: Array, uncertainty: Array) -> PoseGaussian:
        if not (np.isfinite(mean).all() and np.isfinite(uncertainty).all()):
            raise EstimateError(
                f"the network answered with NaN or infinity: mu {mean}, {self._uncertainty} {uncertainty}"
            )
        calibration = self.metadata.calibration
        if not self._pose_alone:
            return self._pose_of_all(mean, uncertainty)
        if self._uncertainty == COVARIANCE:
            return pose_gaussian(mean, calibration.covariance(mean, uncertainty))
        if not (uncertainty > 0.0).all():
            raise EstimateError(f"the network answered with 1/sigma that is not positive: {uncertainty}")
        sigma = 1.0 / uncertainty
        if calibration.correlation:
            return pose_gaussian(mean, calibration.covariance(mean, np.diag(sigma**2)))
        if not calibration.is_identity:
            sigma *= calibration.factors(mean, sigma)
        return gaussian_from_root(mean, sigma)

    def _pose_of_all(self, mean: Array, uncertainty: Array) -> PoseGaussian:
        """The pose of an answer that holds more than xi_sf, or something else; keeps the force."""
        if self._uncertainty == INVERSE_SIGMA and not (uncertainty > 0.0).all():
            raise EstimateError(f"the network answered with 1/sigma that is not positive: {uncertainty}")
        covariance = _covariances(uncertainty[None])[0]
        covariance = self.metadata.calibration.covariance(mean, covariance)
        pose, self.force = self.metadata.contact_model.gaussians(mean, covariance)
        return pose


class _OneImage:
    """Runs a session on one image in memory that stays where it is, which saves a tenth of a millisecond."""

    def __init__(
        self,
        session: onnxruntime.InferenceSession,
        shape: tuple[int, int, int],
        outputs: dict[str, tuple[int, ...]],
    ) -> None:
        self._session = session
        self._binding = session.io_binding()
        self._image = np.zeros((1, *shape), np.float32)
        self._answers = [np.zeros((1, *shape), np.float32) for shape in outputs.values()]
        self._binding.bind_cpu_input(INPUT_NAME, self._image)
        for name, array in zip(outputs, self._answers, strict=True):
            self._binding.bind_output(name, "cpu", 0, np.float32, array.shape, array.ctypes.data)

    def run(self, prepared: NDArray[np.float32]) -> tuple[Array, Array]:
        """Prepared image (1, channels, side, side) -> mean (K,) and the other output, (K,) or (K, K)."""
        if prepared.shape != self._image.shape:
            raise ImageError(f"prepared image: has the shape {prepared.shape}, must be {self._image.shape}")
        np.copyto(self._image, prepared)
        self._session.run_with_iobinding(self._binding)
        mean, uncertainty = (array[0].astype(np.float64) for array in self._answers)
        return mean, uncertainty


def _covariances(uncertainty: Array) -> Array:
    """Inverse standard deviations (N, K) or covariances (N, K, K) -> covariances (N, K, K)."""
    if uncertainty.ndim == 3:
        return uncertainty
    size = uncertainty.shape[1]
    result = np.zeros((len(uncertainty), size, size))
    with np.errstate(divide="ignore"):  # a 1/sigma of 0 is refused where an estimate is made of it
        result[:, range(size), range(size)] = uncertainty**-2.0
    return result


def _model_file(path: Path) -> Path:
    """The path itself, or the model in a run folder."""
    if not path.is_dir():
        return path
    for name in RUN_MODELS:
        if (path / name).is_file():
            return path / name
    raise ModelError(f"{path}: is a folder without {' or '.join(RUN_MODELS)}")


def _open_session(path: Path, threads: int) -> onnxruntime.InferenceSession:
    """Of a file that is as it was written, or that cannot tell, which is said."""
    if not path.is_file():
        hint = " (`make model` trains it)" if path == shipped_model() else ""
        raise ModelError(f"{path}: there is no such model file{hint}")
    data = path.read_bytes()
    try:
        whole = check_sum(data)
    except MetadataError as error:
        raise ModelError(f"{path}: {error}") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # Waiting threads that spin would take the cores from the other nodes.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's exceptions share no base class of their own
        raise ModelError(f"{path}: is not a usable ONNX model: {error}") from error
    if not whole:
        warnings.warn(f"{path}: {_UNSUMMED}", stacklevel=3)
    return session


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
