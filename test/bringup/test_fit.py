"""`tactile fit`: what is fitted to simulated data comes back, and bad input is told."""

import dataclasses

import numpy as np
import pytest

from tactile_bringup.cli import main
from tactile_bringup.fitting import network_error
from tactile_bringup.fitting.network_error import Contacts
from tactile_bringup.fitting.sensor import PARAMETERS, Fit, improve, loss, write
from tactile_geometry import se3
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.markers.labelled import Tracked, track
from tactile_sim.collection import SensorFile, load_sensor, press_then_shear
from tactile_sim.network_error import load_error_model
from tactile_sim.tactip import TacTip

CAMERA = [
    p for p in PARAMETERS if p.name in ("camera.focal_length", "camera.center_row", "camera.rotation_deg")
]
LABELS = np.array([[0, 0, 2, 0, 0, 0], [1, 0, 3, 8, 0, 0], [0, 2, 4, 0, -10, 3], [-2, 1, 1, 5, 5, 0]], float)


def markers_of(sensor: SensorFile) -> Tracked:
    """Markers as a real sensor like this one would show them."""
    tip, positions = TacTip(sensor.sensor), []
    rest = tip.marker_pixels.copy()
    for label in LABELS:
        tip.reset()
        press_then_shear(tip, label * np.repeat([1e-3, np.pi / 180], 3))
        positions.append(tip.marker_pixels.copy())
    return Tracked(LABELS, rest, np.array(positions), np.zeros(len(rest), int))


def test_a_camera_that_stands_otherwise_is_found_from_the_markers(tmp_path):
    camera = SensorFile().sensor.camera.replaced(focal_length=880.0, center_row=243.0, rotation_deg=-52.0)
    true = SensorFile(sensor=dataclasses.replace(SensorFile().sensor, camera=camera))
    tracked = markers_of(true)
    fit, sensor, damping = Fit(tracked, tracked.some(4, 0), SensorFile()), SensorFile(), 1e-3
    before = loss(fit.residual(sensor))
    for _ in range(4):
        sensor, after, damping = improve(fit, sensor, damping, CAMERA)
    assert after < 1e-3 * before
    for parameter, share in zip(CAMERA, (1.0, 0.05, 0.05), strict=True):
        assert parameter.of(sensor) == pytest.approx(parameter.of(true), abs=share), parameter.name
    write(sensor, tmp_path / "found.yaml", "a test")
    again = load_sensor(str(tmp_path / "found.yaml"))
    assert CAMERA[0].of(again) == pytest.approx(CAMERA[0].of(sensor), rel=1e-4)
    assert again.sensor.skin == SensorFile().sensor.skin


def test_a_camera_too_far_off_is_refused():
    tracked = markers_of(SensorFile())
    shifted = dataclasses.replace(tracked, rest=tracked.rest[:, ::-1] * 0.5)
    with pytest.raises(ValueError, match="too far from the real ones to be matched"):
        Fit(shifted, shifted.some(4, 0), SensorFile())


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("labelled")
    options = ("--train", "80", "--val", "0", "--seed", "1", "--jobs", "1")
    narrow = ("--set", "disk_radius=1.5e-3", "--set", "cap_angle=0.15")  # which fewer images can show
    assert main(["data", "generate", str(out), *options, *narrow]) == 0
    return out / "train"


def test_markers_of_labelled_images_are_told_apart(folder):
    tracked = track(open_folder(folder), np.arange(80))
    assert tracked.positions.shape == (80, 331, 2)
    assert np.median(tracked.found) > 0.98
    middle = TacTip().marker_pixels[0]
    assert np.linalg.norm(tracked.rest[0] - middle) < 8.0  # px; markers are 19 apart
    moved = np.linalg.norm(tracked.positions - tracked.rest, axis=2)
    deep, shallow = tracked.labels[:, 2] > 4.0, tracked.labels[:, 2] < 1.0
    assert np.nanmedian(moved[deep]) > 3.0 * np.nanmedian(moved[shallow])


def test_a_folder_without_shallow_contacts_is_refused_before_anything_is_written(
    tmp_path, folder, capsys, monkeypatch
):
    monkeypatch.setattr("tactile_perception.markers.labelled.DEEPEST_REST", 0.01)
    assert main(["fit", "sensor", str(folder), "--out", str(tmp_path / "s.yaml"), "--tracked", "3"]) == 1
    assert "must have contacts less than 0.01 mm deep" in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "s.yaml").exists()


def contacts(count: int, seed: int) -> Contacts:
    """Answers of a network whose depth is off by a tenth of the depth, and which states twice its spread."""
    rng, length = np.random.default_rng(seed), 90
    size = count * length
    limits = np.array([3e-3, 3e-3, 2.5e-3, 0.2, 0.2, 0.1])
    pose = rng.uniform(-limits, limits, (size, 6))
    pose[:, 2] += 3.5e-3
    spread = np.array([2e-4, 2e-4, 1e-4, 5e-3, 5e-3, 1e-2])
    error = spread * rng.normal(size=(size, 6))
    error[:, 2] += 0.1 * pose[:, 2]
    truth = np.array([se3.pose_from_euler(p) for p in pose])
    sigma = np.tile(2.0 * spread, (size, 1))
    nees = np.sum((error / sigma) ** 2, axis=1)
    depths = np.full(count, 3e-4), np.full(count, 2e-4)
    return Contacts(
        np.repeat(np.arange(count), length), truth, rng.random(size) < 0.5, error, error, sigma, nees, *depths
    )


def test_the_bias_and_what_is_stated_come_back_from_a_network_that_errs_as_told():
    data, held = contacts(60, 0), contacts(20, 1)
    model = network_error.fit(data, held)
    bias = (model.features(held.pose, held.slips.astype(float)) @ model.coefficients)[:, :6]
    np.testing.assert_allclose(bias[:, 2], 0.1 * held.pose[:, 2], atol=6e-5)
    np.testing.assert_allclose(bias[:, 0], 0.0, atol=1e-4)
    answers = network_error.drawn(model, held, seed=3)
    np.testing.assert_allclose(np.median(answers.sigma, axis=0), np.median(held.sigma, axis=0), rtol=0.05)
    np.testing.assert_allclose(answers.error.std(axis=0), held.error.std(axis=0), rtol=0.15)


def test_a_fit_to_the_shipped_network_is_a_file_that_sensors_read(tmp_path, capsys):
    out = tmp_path / "errors.npz"
    assert main(["fit", "network-error", "--contacts", "3", "--held-out", "2", "--out", str(out)]) == 0
    model = load_error_model(out)
    assert model.coefficients.shape == (49, 18) and np.isfinite(model.coefficients).all()
    assert 0.0 < model.leave <= model.touch < 1.5e-3
    assert "180 exposures held out" in " ".join(capsys.readouterr().out.split())
