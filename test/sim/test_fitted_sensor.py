"""The sensor that errs as the network does: its statistics are those of the network on other contacts."""

import numpy as np
import pytest

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_bringup.offline_perception import network_view
from tactile_control.task_file import load_task, task_path
from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes.plane import Plane
from tactile_scene.shapes.sphere import Sphere, SphereSettings
from tactile_scene.simulated_sensors import FittedSensorSettings
from tactile_sim.fitted_sensor import FittedSensor
from tactile_sim.network_error import NetworkError, load_error_model
from tactile_sim.tactip import TacTip

CONTACTS = 48


def at(x, depth, tilt=0.0):
    return se3.pose_from_euler([x, 0.0, 0.020 - depth, np.pi + tilt, 0.0, 0.0])


@pytest.fixture(scope="module")
def contacts():
    """True X_fs, whether it slips, error and NEES of the network, at contacts pressed, rolled and sheared."""
    estimator, rng, rows = Estimator(), np.random.default_rng(11), []
    sensor = TacTip(view=network_view(estimator))
    for number in range(CONTACTS):
        sensor.reset(number)
        ball = Sphere(SphereSettings(radius=1.0 / rng.uniform(0.5, 16.0)))
        center = ball.settings.radius + 0.020
        pressed = np.array([0.0, 0.0, center - rng.uniform(1.5e-3, 5.5e-3), np.pi, 0.0, 0.0])
        pressed[3:5] += rng.normal(0.0, 0.12, 2)
        moved = pressed + rng.normal(size=6) * [3e-3, 3e-3, 4e-4, 0.08, 0.08, 0.04]
        above = pressed.copy()
        above[2] += 7e-3
        for pose in (above, pressed, moved):
            sensor.advance(ball, se3.pose_from_euler(pose))
        truth = sensor.truth()
        stated = estimator.estimate_prepared(estimator.preprocessor.from_processed(sensor.image()))
        rows.append((truth.T_fs, truth.slip_fraction > 0.5, *judged(stated, truth.T_fs)))
    return [np.array(column) for column in zip(*rows, strict=True)]


def judged(stated, T_fs):
    """Error of a statement about X_sf, and its NEES."""
    error = se3.log(stated.mean @ T_fs)
    return error, error @ np.linalg.solve(stated.cov, error)


@pytest.fixture(scope="module")
def drawn(contacts):
    """Errors (draws, contacts, 6) and NEES (draws, contacts) of the model at the same contacts."""
    errors, rows = NetworkError(load_error_model(), seed=1), []
    for _ in range(40):
        for T_fs, slips in zip(*contacts[:2], strict=True):
            errors.begin()
            rows.append(judged(errors.estimate(T_fs, bool(slips)), T_fs))
    error, nees = (np.array(column) for column in zip(*rows, strict=True))
    return error.reshape(40, CONTACTS, 6), nees.reshape(40, CONTACTS)


def test_errors_are_as_large_as_those_of_the_network(contacts, drawn):
    network = np.sqrt(np.mean(contacts[2] ** 2, axis=0))
    model = np.sqrt(np.mean(drawn[0] ** 2, axis=(0, 1)))
    assert (model > network / 1.8).all() and (model < 1.8 * network).all()


def test_the_mean_error_of_the_network_is_one_that_the_model_may_have(contacts, drawn):
    means = drawn[0].mean(axis=1)
    off = (contacts[2].mean(axis=0) - means.mean(axis=0)) / means.std(axis=0)
    assert np.abs(off).max() < 4.0


def test_it_is_as_sure_of_itself_as_the_network(contacts, drawn):
    for quantile in (0.5, 0.9):
        network, model = np.quantile(contacts[3], quantile), np.quantile(drawn[1], quantile)
        assert network / 2.5 < model < 2.5 * network


def test_an_error_stays_while_the_contact_does_and_goes_on_the_way_to_another():
    near, far = [], []
    for seed in range(200):
        errors = NetworkError(load_error_model(), seed)
        stays, goes = np.diag([1.0, 1.0, 1.0, 1.0]), np.eye(4)
        stays[2, 3], goes[:3, 3] = 3e-3, (8e-3, 0.0, 3e-3)
        first, second, third = (judged(errors.estimate(T, False), T)[0] for T in (stays, stays, goes))
        near.append((first, second))
        far.append((first, third))
    similar = [
        np.array([np.corrcoef(*np.array(pairs)[:, :, k].T)[0, 1] for k in range(6)]) for pairs in (near, far)
    ]
    assert similar[0].min() > 0.8
    assert np.abs(similar[1]).max() < 0.3


def test_contacts_side_by_side_err_as_one_does_each_and_begin_when_told():
    model = load_error_model()
    pose = np.array([0.001, -0.002, 0.003, 0.1, -0.05, 0.02])
    one, many = NetworkError(model, 4), NetworkError(model, 4, (1,))
    for further in (0.0, 1e-3, 2e-3):
        single, several = one.errors(pose + further, 1.0), many.errors(pose[None] + further, np.ones(1))
        for a, b in zip(single, several, strict=True):
            assert b[0] == pytest.approx(a, rel=1e-9, abs=1e-15)
    side = NetworkError(model, 5, (400,))
    still = np.tile(pose, (400, 1))
    first, _ = side.errors(still, np.zeros(400))
    new = np.arange(400) < 200
    side.begin(new)
    second, _ = side.errors(still, np.zeros(400))
    alike = [[np.corrcoef(first[part, k], second[part, k])[0, 1] for k in range(6)] for part in (new, ~new)]
    assert np.abs(alike[0]).max() < 0.3  # 4 deviations of a correlation of 200 pairs
    assert min(alike[1]) > 0.8


def test_the_same_seed_gives_the_same_bits_and_another_one_others():
    def means(seed):
        sensor = FittedSensor(seed=seed)
        for depth in (-1e-3, 2e-3, 3e-3):
            sensor.advance(Plane(), at(0.0, depth))
        return sensor.estimate().mean

    assert (means(1) == means(1)).all() and (means(1) != means(2)).any()


def test_contact_is_seen_later_than_it_begins_and_until_it_is_nearly_over():
    sensor, model = FittedSensor(), load_error_model()
    seen = []
    depths = [
        -1e-4,
        0.5 * model.touch,
        1.2 * model.touch,
        0.7 * model.touch,
        0.5 * model.leave,
        0.7 * model.touch,
    ]
    for depth in depths:
        sensor.advance(Plane(), at(0.0, depth))
        seen.append(sensor.estimate() is not None)
    assert 0.0 < model.leave < 0.7 * model.touch < 1e-3
    assert seen == [False, False, True, True, False, False]


def test_noise_of_the_settings_comes_on_top():
    plain = FittedSensor(seed=3)
    noisy = FittedSensor(FittedSensorSettings(sigma_position=(1e-3, 1e-3, 1e-3)), seed=3)
    for sensor in (plain, noisy):
        sensor.advance(Plane(), at(0.0, 3e-3))
    first, second = plain.estimate(), noisy.estimate()
    more = np.diag(second.cov - first.cov)
    assert more == pytest.approx([1e-6] * 3 + [0.0] * 3, abs=1e-12)
    assert (first.mean != second.mean).any()


def test_a_scene_with_it_closes_the_loop_and_its_beliefs_show_the_bias_of_the_network():
    scene = load_scene("plane").with_fidelity("fitted")
    assert scene.simulation.sensors["arm"].fidelity == "fitted" and not scene.gives_images("arm")
    task = load_task(task_path("surface_following"), "plane", changes=["follower.task.timeout=1.0"])
    record = run_offline(scene, task, OfflineOptions(seed=2))
    assert "the path was not done" in record.result["reason"]  # a second of it is enough here
    working = record.working(record.truth.stamp_ns)
    assert record.truth.in_contact[working].all() and len(record.estimate) > 60
    again = run_offline(scene, task, OfflineOptions(seed=2))
    assert (again.belief.mean == record.belief.mean).all()
