"""The estimator: faulty models and answers, and the covariance of the left perturbation."""

import dataclasses
import json
import os
import time

import numpy as np
import pytest
from scipy.linalg import expm, logm
from tangent import hat, vee

from tactile_perception.estimating.estimator import Estimator, ModelError, shipped_model
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.labels import NETWORK_SCALE, EstimateError, pose_gaussian
from tactile_perception.evaluation.calibration import Calibration

MEAN = np.array([1.2, -2.0, -3.5, 0.3, -0.4, 0.08])
INVERSE_SIGMA = np.array([2.0, 3.0, 10.0, 80.0, 120.0, 40.0])
IMAGE = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)


def left_perturbation(xi: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Eps with exp(eps^) exp(mean^) = exp(xi^)."""
    return vee(logm(expm(hat(xi)) @ np.linalg.inv(expm(hat(mean)))).real)


def test_covariance_is_that_of_the_left_perturbation():
    """Each of the network's independent deviations, carried to the left of the mean by finite differences."""
    mean = MEAN * NETWORK_SCALE
    sigma = NETWORK_SCALE / INVERSE_SIGMA
    step = 1e-4
    columns = []
    for deviation in np.diag(sigma):
        forward = left_perturbation(mean + step * deviation, mean)
        columns.append((forward - left_perturbation(mean - step * deviation, mean)) / (2.0 * step))
    expected = np.array(columns).T @ np.array(columns)
    gaussian = pose_gaussian(MEAN, np.diag(INVERSE_SIGMA**-2))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(gaussian.cov / scale, expected / scale, rtol=0, atol=1e-6)
    np.testing.assert_allclose(gaussian.mean, expm(hat(mean)), atol=1e-12)


def test_answer_is_in_si_units():
    gaussian = pose_gaussian(np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0]), 0.25 * np.eye(6))
    assert gaussian.mean[2, 3] == pytest.approx(-0.003)
    assert gaussian.cov[2, 2] == pytest.approx(0.0005**2)
    assert gaussian.cov[5, 5] == pytest.approx(0.5**2)


@pytest.mark.parametrize("inverse_sigma", [np.full(6, 1e-6), np.full(6, 1e6)])
def test_covariance_is_symmetric_and_positive_at_the_bounds_of_sigma(inverse_sigma):
    cov = pose_gaussian(MEAN, np.diag(inverse_sigma**-2)).cov
    np.testing.assert_array_equal(cov, cov.T)
    assert np.all(np.linalg.eigvalsh(cov) > 0.0)


@pytest.mark.parametrize("correlation", [(), tuple(map(tuple, np.eye(6) + 0.3 * (1 - np.eye(6))))])
@pytest.mark.parametrize("factor", [1.0, 1.7])
def test_the_estimate_of_an_image_is_the_calibrated_prediction(
    constant_model, model_metadata, correlation, factor
):
    calibration = Calibration(sigma_values=((float(np.log(factor)),),) * 6, correlation=correlation)
    metadata = dataclasses.replace(model_metadata(), calibration=calibration)
    path = constant_model(mu=MEAN, inverse_sigma=INVERSE_SIGMA, properties=metadata.to_properties())
    estimator = Estimator(path)
    mean, covariance = estimator.predict(estimator.preprocessor(IMAGE))
    np.testing.assert_allclose(np.diagonal(covariance[0]), (factor / INVERSE_SIGMA) ** 2, rtol=1e-4)
    expected, estimate = pose_gaussian(mean[0], covariance[0]), estimator.estimate(IMAGE)
    np.testing.assert_array_equal(estimate.mean, expected.mean)
    variances = np.diagonal(expected.cov)
    scale = np.sqrt(np.outer(variances, variances))
    np.testing.assert_allclose(estimate.cov / scale, expected.cov / scale, rtol=0, atol=1e-12)


def test_of_a_run_folder_the_quantized_model_is_taken_if_there_is_one(tmp_path, constant_model):
    with pytest.raises(ModelError, match=r"is a folder without model_int8\.onnx or model\.onnx"):
        Estimator(tmp_path)
    model = constant_model().rename(tmp_path / "model.onnx")
    assert Estimator(tmp_path).path == model
    quantized = constant_model(mu=MEAN).rename(tmp_path / "model_int8.onnx")
    assert Estimator(tmp_path).path == quantized


def test_earlier_estimates_stay_as_they_were():
    estimator = Estimator()
    first = estimator.estimate(IMAGE)
    kept = first.mean.copy(), first.cov.copy()
    estimator.estimate(np.zeros((480, 640), np.uint8))
    np.testing.assert_array_equal(first.mean, kept[0])
    np.testing.assert_array_equal(first.cov, kept[1])


def test_a_prepared_image_of_another_shape_is_refused():
    estimator = Estimator()
    for shape in ((2, 1, 128, 128), (1, 1, 1, 128), (128, 128)):
        with pytest.raises(ImageError, match=r"must be \(1, 1, 128, 128\)"):
            estimator.estimate_prepared(np.zeros(shape, np.float32))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["mu", "inverse_sigma"])
def test_nan_and_infinity_are_no_estimate(constant_model, bad, where):
    values = {"mu": MEAN.copy(), "inverse_sigma": INVERSE_SIGMA.copy()}
    values[where][3] = bad
    with pytest.raises(EstimateError, match="NaN or infinity"):
        Estimator(constant_model(**values)).estimate(IMAGE)


@pytest.mark.parametrize("bad", [0.0, -1.0])
def test_a_sigma_without_an_inverse_is_no_estimate(constant_model, bad):
    with pytest.raises(EstimateError, match="not positive"):
        Estimator(constant_model(inverse_sigma=[1.0, 1.0, bad, 1.0, 1.0, 1.0])).estimate(IMAGE)


@pytest.mark.parametrize("eigenvalue", [0.0, -0.1])
def test_a_covariance_that_is_not_positive_definite_is_no_estimate(eigenvalue):
    covariance = np.eye(6)
    covariance[:2, :2] = [[1.0, 1.0 - eigenvalue], [1.0 - eigenvalue, 1.0]]
    with pytest.raises(EstimateError, match="not positive definite"):
        pose_gaussian(MEAN, covariance)


def test_correlations_reach_the_covariance_of_the_pose():
    """By samples of the network's Gaussian, as left perturbations."""
    rng = np.random.default_rng(3)
    root = np.diag(1.0 / INVERSE_SIGMA) @ np.tril(rng.normal(size=(6, 6)) * 0.4 + np.eye(6))
    mean = MEAN * NETWORK_SCALE
    samples = 1e-3 * rng.normal(size=(400, 6)) @ root.T * NETWORK_SCALE
    expected = np.cov(np.array([left_perturbation(mean + sample, mean) for sample in samples]).T)
    given = np.cov((samples / NETWORK_SCALE).T)
    gaussian = pose_gaussian(MEAN, given)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(gaussian.cov / scale, expected / scale, atol=1e-3)


def test_calibration_in_the_model_file_is_applied(constant_model, model_metadata):
    calibration = Calibration(sigma_values=tuple((np.log(factor),) for factor in (2, 3, 4, 5, 6, 7)))
    metadata = dataclasses.replace(model_metadata(), calibration=calibration)
    path = constant_model(MEAN, INVERSE_SIGMA, properties=metadata.to_properties())
    estimator = Estimator(path)
    factors = np.arange(2.0, 8.0)
    expected = pose_gaussian(MEAN, np.diag((factors / INVERSE_SIGMA) ** 2))
    np.testing.assert_allclose(estimator.estimate(IMAGE).cov, expected.cov, rtol=1e-4, atol=1e-12)
    prepared = estimator.preprocessor(IMAGE)
    calibrated, own = (f(prepared)[1][0] for f in (estimator.predict, estimator.predict_uncalibrated))
    np.testing.assert_allclose(np.diag(calibrated) / np.diag(own), factors**2, rtol=1e-4)


def test_a_damaged_calibration_is_refused(constant_model, model_metadata):
    properties = model_metadata().to_properties() | {"calibration": '{"format": "other"}'}
    with pytest.raises(ModelError, match="calibration: format is 'other'"):
        Estimator(constant_model(properties=properties))


def test_model_answers_reach_the_pose(constant_model):
    gaussian = Estimator(constant_model(MEAN, INVERSE_SIGMA)).estimate(IMAGE)
    expected = pose_gaussian(MEAN, np.diag(INVERSE_SIGMA**-2))
    np.testing.assert_allclose(gaussian.mean, expected.mean, atol=1e-5)
    np.testing.assert_allclose(gaussian.cov, expected.cov, rtol=1e-4, atol=1e-12)


def test_missing_model_file_is_named(tmp_path):
    with pytest.raises(ModelError, match=r"nowhere\.onnx: there is no such model file"):
        Estimator(tmp_path / "nowhere.onnx")


def test_a_file_that_is_no_model_is_named(tmp_path):
    path = tmp_path / "text.onnx"
    path.write_text("hello")
    with pytest.raises(ModelError, match=r"text\.onnx: is not a usable ONNX model"):
        Estimator(path)


def test_an_input_of_another_size_than_the_preprocessing_is_refused(constant_model):
    with pytest.raises(ModelError, match=r"input.*64.*must have image float32 \(N, 1, 128, 128\)"):
        Estimator(constant_model(side=64))


def test_an_input_of_another_name_is_refused(constant_model):
    with pytest.raises(ModelError, match="must have image float32"):
        Estimator(constant_model(input_name="x"))


def test_outputs_of_the_wrong_shape_are_refused(constant_model):
    with pytest.raises(ModelError, match=r"outputs mu .*5.*must have mu float32 \(N, 6\)"):
        Estimator(constant_model(mu=(0.0,) * 5))


def test_a_model_without_metadata_is_refused_with_what_is_missing(constant_model):
    with pytest.raises(ModelError, match="metadata has no format, preprocessing"):
        Estimator(constant_model(properties={}))


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("units", json.dumps(["m"] * 6), "units are .*must be"),
        ("format", "other/2", "format is 'other/2', must be"),
        ("preprocessing", json.dumps({"bbox": [0, 0, 1, 9999]}), "bbox"),
        ("preprocessing", "{", "unreadable metadata"),
        ("preprocessing", "3", "unreadable metadata"),
        ("preprocessing", "[" * 100_000, "unreadable metadata: nested too deeply"),
        ("preprocessing", '{"size": ' + "9" * 5000 + "}", "unreadable metadata: size = inf"),
        ("units", "null", "units are None, must be"),
        ("components", "1", "components are 1, must be"),
        ("training_data", "null", "training_data is None, must hold names and values"),
        ("training_data", '{"start": 1}', "training_data.start is 1, must hold names and values"),
        ("training_data", '{"start": {"holdback": "much"}}', "holdback is 'much', must be a part"),
        ("validation", "[]", r"validation is \[\], must hold names and values"),
        ("training", "7", "training is 7, must hold names and values"),
        ("training", '{"members": 2}', "training.members is 2, must be a list"),
        ("training", '{"members": [2]}', "training.members is 2, must hold names and values"),
        ("training", '{"network": null}', "training.network is None, must hold names and values"),
        ("training", '{"training": {"holdback": null}}', "holdback is None, must be a part of the data"),
        ("calibration", "[" * 100_000, "calibration: is not JSON: nested too deeply"),
        ("calibration", "1e999", "calibration: format is None"),
    ],
    ids=lambda text: text[:40],
)
def test_metadata_of_another_convention_is_refused(constant_model, model_metadata, name, value, message):
    properties = model_metadata().to_properties() | {name: value}
    with pytest.raises(ModelError, match=message):
        Estimator(constant_model(properties=properties))


def test_a_file_in_which_a_bit_was_flipped_is_refused_before_anything_is_made_of_it(constant_model):
    path = constant_model()
    whole = path.read_bytes()
    key = range(whole.index(b"file_sha256"), whole.index(b"file_sha256") + len("file_sha256") + 2)
    for position in np.random.default_rng(0).permutation(len(whole))[:300]:
        if position in key:  # then it is a file without a checksum
            continue
        damaged = bytearray(whole)
        damaged[position] ^= 1 << (position % 8)
        path.write_bytes(damaged)
        with pytest.raises(ModelError, match=r"constant\.onnx: is damaged"):
            Estimator(path)


def test_a_file_without_a_checksum_is_used_and_the_user_told(constant_model):
    path = constant_model()
    path.write_bytes(path.read_bytes().replace(b"file_sha256", b"file_sha255"))
    with pytest.warns(UserWarning, match=r"constant\.onnx: has no checksum.*`tactile calibrate`"):
        assert Estimator(path).estimate(IMAGE).cov.shape == (6, 6)


def test_a_pipe_as_a_model_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "pipe.onnx")
    with pytest.raises(ModelError, match=r"pipe\.onnx: there is no such model file"):
        Estimator(tmp_path / "pipe.onnx")


def test_metadata_survives_the_way_through_a_model_file(constant_model, model_metadata):
    expected = model_metadata(median=3, bbox=(100, 10, 540, 450))
    assert Estimator(constant_model(properties=expected.to_properties())).metadata == expected


def test_images_of_the_wrong_shape_are_refused_before_the_network(constant_model):
    estimator = Estimator(constant_model())
    with pytest.raises(ImageError, match="must be 640x480"):
        estimator.estimate(IMAGE[:240])
    with pytest.raises(ImageError, match="must be a gray image"):
        estimator.estimate_processed(np.zeros((440, 445, 3), np.uint8))


@pytest.fixture(scope="module")
def shipped() -> Estimator:
    return Estimator(shipped_model())


def test_shipped_model_says_what_it_was_made_from(shipped):
    metadata = shipped.metadata
    assert len(metadata.training_data["sha256"]) == 64 and metadata.training_data["samples"] >= 1000
    assert len(metadata.validation["mae"]) == 6
    assert metadata.training["training"]["learning_rate_peak"] > 0.0
    assert "{s}" in metadata.frames


def test_camera_image_and_processed_crop_give_the_same_estimate(shipped):
    whole = shipped.estimate(IMAGE)
    crop = shipped.estimate_processed(shipped.preprocessor.processed(IMAGE))
    np.testing.assert_array_equal(whole.mean, crop.mean)
    np.testing.assert_array_equal(whole.cov, crop.cov)


def test_stage_times_add_up_to_what_a_caller_waits(shipped):
    started = time.perf_counter()
    shipped.estimate(IMAGE)
    waited = time.perf_counter() - started
    assert 0.0 < shipped.times.infer < shipped.times.total <= waited


def test_estimates_are_the_same_bits_each_time(shipped):
    first, second = shipped.estimate(IMAGE), shipped.estimate(IMAGE)
    np.testing.assert_array_equal(first.mean, second.mean)
    np.testing.assert_array_equal(first.cov, second.cov)
