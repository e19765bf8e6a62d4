"""`tactile estimate` on folders and videos, and the way of an estimate through the filter."""

import argparse
import csv
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_folder

from tactile_bringup.commands import estimate as commands
from tactile_geometry.gaussian import PoseGaussian
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.estimating.contact_model import SURFACE
from tactile_perception.estimating.estimator import Estimator, shipped_model
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.labels import (
    label_from_euler,
    pose_gaussian,
    surface_contact_pose,
    tangent_gaussian,
)
from tactile_perception.estimating.run import EstimateTable, run_estimates
from tactile_perception.estimating.sources import (
    Frame,
    SourceError,
    folder_frames,
    read_poses,
    usable_order,
    video_frames,
)
from tactile_perception.evaluation.filtering import motion_filter, with_motion_noise

IMAGE = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)
INVERSE_SIGMA = np.array([2.0, 2.0, 8.0, 100.0, 100.0, 40.0])


class NoisyEstimator:
    """Stands in for a network: the label of each frame, in turn, with Gaussian noise of known size."""

    def __init__(self, labels: np.ndarray, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self._answers = iter(labels + rng.normal(size=labels.shape) / INVERSE_SIGMA)
        self.times = type("Times", (), {"preprocess": 0.0, "infer": 0.0, "convert": 0.0})()
        self.metadata = type("Metadata", (), {"novelty": None, "contact_model": SURFACE})()
        self.force = None

    def estimate_processed(self, image: np.ndarray) -> PoseGaussian:
        return pose_gaussian(next(self._answers), np.diag(INVERSE_SIGMA**-2))


def random_contacts(count: int, seed: int = 0) -> np.ndarray:
    low, high = [-4, -4, 0.5, -15, -15, -5], [4, 4, 6, 15, 15, 5]
    return np.random.default_rng(seed).uniform(low, high, (count, 6))


def frames_of(contacts: np.ndarray) -> list[Frame]:
    return [
        Frame(f"{k}", k * 10**8, IMAGE, True, euler, surface_contact_pose(euler))
        for k, euler in enumerate(contacts)
    ]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    images = (np.roll(IMAGE, number, axis=1) for number in range(1, 13))
    return write_folder(tmp_path / "data", zip(images, random_contacts(12), strict=True))


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480))
    for k in range(9):
        writer.write(cv2.cvtColor(np.roll(IMAGE, k, axis=0), cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def estimated(source: object, model: Path, out: Path, **changes: object) -> int:
    parser = argparse.ArgumentParser(prog="tactile")
    commands.register(parser.add_subparsers())
    parsed = parser.parse_args(["estimate", str(source), "--model", str(model), "--out", str(out)])
    vars(parsed).update(changes)
    return parsed.run(parsed)


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_deviations_survive_the_way_through_the_left_perturbation():
    mean = np.array([1.0, -2.0, -3.0, 0.3, -0.2, 0.1])
    recovered, covariance = tangent_gaussian(pose_gaussian(mean, np.diag(INVERSE_SIGMA**-2)))
    np.testing.assert_allclose(recovered, mean, atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), 1.0 / INVERSE_SIGMA, rtol=1e-9)


def test_filter_reduces_errors_where_the_motion_is_known():
    """As in the paper's table: the better the motion is known, the smaller the errors."""
    contacts = random_contacts(150)
    labels = np.array([label_from_euler(euler) for euler in contacts])
    errors = []
    for sigma in (1.0, 0.01):
        frames = with_motion_noise(frames_of(contacts), sigma, seed=2)
        table = run_estimates(NoisyEstimator(labels, seed=1), frames, motion_filter(sigma))
        errors += [table.mean_absolute_error(table.network), table.mean_absolute_error(table.filtered)]
    np.testing.assert_array_equal(errors[0], errors[2])
    assert np.all(errors[1][:2] < 0.95 * errors[0][:2])
    assert np.all(errors[3] < 0.5 * errors[2])


def test_smoothing_errs_less_than_filtering():
    contacts = random_contacts(150)
    labels = np.array([label_from_euler(euler) for euler in contacts])
    errors = []
    for smoothed in (False, True):
        frames = with_motion_noise(frames_of(contacts), 0.1, seed=2)
        table = run_estimates(NoisyEstimator(labels, seed=1), frames, motion_filter(0.1), smoothed=smoothed)
        errors.append(table.mean_absolute_error(table.filtered))
    assert np.all(errors[1] < errors[0])
    assert np.mean(errors[1] / errors[0]) < 0.85


def test_motion_noise_has_the_size_asked_for():
    contacts = random_contacts(400)
    frames = list(with_motion_noise(frames_of(contacts), 0.5, seed=0))
    true = [surface_contact_pose(euler) for euler in contacts]
    psi = []
    for k in range(1, len(frames)):
        noisy = np.linalg.inv(frames[k].T_base_sensor) @ frames[k - 1].T_base_sensor
        psi.append(noisy @ np.linalg.inv(np.linalg.inv(true[k]) @ true[k - 1]))
    rotation = np.array([[p[2, 1] - p[1, 2], p[0, 2] - p[2, 0], p[1, 0] - p[0, 1]] for p in psi]) / 2.0
    np.testing.assert_allclose(rotation.std(axis=0), np.radians(0.5), rtol=0.15)
    np.testing.assert_allclose(np.array(psi)[:, :3, 3].std(axis=0), 0.5e-3, rtol=0.15)


def test_a_folder_becomes_a_table_and_a_picture(folder, constant_model, tmp_path):
    out = tmp_path / "out"
    assert estimated(folder, constant_model((0, 0, -3.0, 0, 0, 0)), out) == 0
    table = rows(out / "estimates.csv")
    assert sorted(row["name"] for row in table) == sorted(f"image_{k}.png" for k in range(1, 13))
    assert float(table[0]["network_rho_z_mm"]) == pytest.approx(-3.0, abs=1e-4)
    assert float(table[0]["network_z_mm"]) == pytest.approx(3.0, abs=1e-4)
    assert all(row["filtered_rho_x_mm"] and row["label_rho_x_mm"] for row in table)
    assert (out / "predicted_against_actual.png").stat().st_size > 10_000


def test_processed_images_of_another_size_are_taken_as_they_are_and_told(
    folder, constant_model, tmp_path, capsys
):
    for path in (folder / "processed_images").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)[:420, :420])
    (folder / "process_image_params.json").write_text('{"bbox": [110, 30, 530, 450]}')
    (folder / "processed_image_params.json").unlink()
    out = tmp_path / "out"
    assert estimated(folder, constant_model(), out) == 0
    assert len(rows(out / "estimates.csv")) == 12
    told = capsys.readouterr().err
    assert "bbox = (110, 30, 530, 450), not (105, 20, 550, 460)" in told
    assert "processed images are 420x420, not 445x440" in told


def test_errors_are_those_of_the_labels(folder, constant_model):
    source = open_folder(folder)
    estimator = Estimator(constant_model((0.5, 0, -3.0, 0, 0, 0)))
    table = run_estimates(estimator, folder_frames(source, usable_order(source, 0, None)), None)
    labels = np.array([label_from_euler(euler) for euler in source.euler_mm_deg])
    expected = np.abs(labels - [0.5, 0, -3.0, 0, 0, 0]).mean(axis=0)
    np.testing.assert_allclose(table.mean_absolute_error(table.network), expected, atol=1e-4)


def test_a_video_without_poses_becomes_a_table_and_a_time_series(video, constant_model, tmp_path):
    out = tmp_path / "out"
    assert estimated(video, constant_model(), out) == 0
    table = rows(out / "estimates.csv")
    assert len(table) == 9
    assert int(table[3]["stamp_ns"]) == pytest.approx(1e8, rel=0.01)
    assert table[0]["label_rho_x_mm"] == "" and table[0]["filtered_rho_x_mm"] == ""
    assert (out / "estimates.png").exists()


def test_a_video_with_poses_is_filtered(video, constant_model, tmp_path):
    poses = tmp_path / "poses.csv"
    poses.write_text("x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n" + "0,0,3,0,0,0\n" * 9)
    out = tmp_path / "out"
    model = constant_model((0, 0, -3.0, 0, 0, 0), INVERSE_SIGMA)
    assert estimated(video, model, out, poses=poses) == 0
    last = rows(out / "estimates.csv")[-1]
    assert float(last["filtered_rho_z_mm"]) == pytest.approx(-3.0, abs=1e-4)
    assert float(last["filtered_sigma_rho_x_mm"]) < float(last["network_sigma_rho_x_mm"])


def test_a_network_that_fails_on_an_image_is_told_and_the_others_go_on(folder, constant_model):
    source = open_folder(folder)
    estimator = Estimator(constant_model((np.nan,) * 6))
    table = run_estimates(estimator, folder_frames(source, usable_order(source, 0, 3)), motion_filter(1.0))
    assert len(table) == 3 and len(table.failures) == 3
    assert "NaN" in table.failures[0]
    assert np.isnan(table.mean_absolute_error(table.network)).all()


def test_unusable_images_are_left_out_and_named(folder):
    (folder / "processed_images" / "image_4.png").write_bytes(b"x")
    source = open_folder(folder)
    order = usable_order(source, 0, None)
    assert len(order) == 11
    assert "image_4.png" in source.report.problems["unusable image"][0]


def test_a_video_of_another_size_is_an_error(tmp_path, constant_model):
    path = tmp_path / "small.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (320, 240))
    writer.write(np.zeros((240, 320, 3), np.uint8))
    writer.release()
    with pytest.raises(ImageError, match="must be 640x480 pixels, is 320x240"):
        run_estimates(Estimator(constant_model()), video_frames(str(path), None, None), None)


@pytest.mark.parametrize(
    "text, message",
    [
        ("x_mm,y_mm\n1,2\n", "has no column z_mm"),
        ("x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n1,2,3,4,5,nan\n", "line 2: a pose must be finite"),
        ("x_mm,y_mm,z_mm,alpha_deg,beta_deg,gamma_deg\n1,2,3,4,5\n", "cannot be read as a table"),
    ],
)
def test_unusable_poses_are_an_error_with_the_place(tmp_path, text, message):
    path = tmp_path / "poses.csv"
    path.write_text(text)
    with pytest.raises(SourceError, match=message):
        read_poses(path)


def test_fewer_poses_than_frames_is_an_error(video):
    with pytest.raises(SourceError, match="more frames than there are poses"):
        list(video_frames(str(video), [np.eye(4)] * 4, None))


@pytest.mark.parametrize("source", ["nowhere", "no_video.avi"])
def test_a_source_that_is_nothing_is_told_on_the_command_line(tmp_path, constant_model, capsys, source):
    (tmp_path / "no_video.avi").write_text("hello")
    status = estimated(tmp_path / source, constant_model(), tmp_path / "out")
    assert status == 1
    assert "tactile estimate:" in capsys.readouterr().err


def test_the_simulators_model_on_images_that_are_not_said_to_be_simulated_is_told(folder, tmp_path, capsys):
    source = tmp_path / "copy"
    shutil.copytree(folder, source)
    assert estimated(source, shipped_model(), tmp_path / "out", no_filter=True, limit=1) == 0
    assert "the shipped model has seen simulated images alone" in capsys.readouterr().err
    (source / "collect_params.json").write_text('{"robot": "sim"}')
    assert estimated(source, shipped_model(), tmp_path / "out", no_filter=True, limit=1) == 0
    assert "simulated images alone" not in capsys.readouterr().err


def test_a_missing_model_is_told_on_the_command_line(folder, tmp_path, capsys):
    assert estimated(folder, tmp_path / "m.onnx", tmp_path / "out") == 1
    assert "there is no such model file" in capsys.readouterr().err


def test_an_empty_table_has_no_error():
    assert np.isnan(EstimateTable().mean_absolute_error(EstimateTable().network)).all()
