"""Labelled samples: the paper's sampling rules, determinism, and what a label means."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tactile_base.jobs import Workers, run_jobs
from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_scene.sampling import SamplingSettings, pose_of, sample_pose
from tactile_sim.collection import CollectionSettings, Collector, collect, generate
from tactile_sim.tactip import TacTip


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.array([sample_pose(SamplingSettings(), rng) for _ in range(4000)])


def test_shear_fills_its_disk_evenly(poses):
    radius = np.hypot(poses[:, 0], poses[:, 1])
    assert radius.max() <= 5e-3
    assert np.mean(radius < 2.5e-3) == pytest.approx(0.25, abs=0.03)


def test_contacts_fill_their_cap_evenly(poses):
    into = np.array([se3.pose_from_euler(pose)[2, :3] for pose in poses])  # z of {f} in {s}
    angle = np.arccos(into[:, 2])
    assert np.degrees(angle.max()) <= 25.0 + 1e-9
    half = np.arccos((1 + np.cos(np.radians(25))) / 2)
    assert np.mean(angle < half) == pytest.approx(0.5, abs=0.03)
    assert np.abs(into[:, :2].mean(axis=0)).max() < 0.02


def test_depth_and_rotation_are_uniform(poses):
    assert poses[:, 2].min() >= 0.5e-3 and poses[:, 2].max() <= 6e-3
    assert poses[:, 2].mean() == pytest.approx(3.25e-3, abs=1e-4)
    assert np.degrees(np.abs(poses[:, 5]).max()) <= 5.0


def test_a_sample_depends_on_seed_and_index_only():
    settings = CollectionSettings()
    forward = list(generate(settings, 7, [0, 1, 2]))
    backward = list(generate(settings, 7, [2, 0]))
    assert [sample.index for sample in forward] == [0, 1, 2]
    assert np.array_equal(forward[2].image, backward[0].image)
    assert np.array_equal(forward[0].image, backward[1].image)
    assert not np.array_equal(forward[0].euler_mm_deg, next(generate(settings, 8, [0])).euler_mm_deg)


def test_the_pose_of_a_sample_is_known_without_collecting_it():
    sample = next(generate(CollectionSettings(), 7, [3]))
    expected = pose_of(SamplingSettings(), 7, 3) / np.repeat([1e-3, np.pi / 180], 3)
    np.testing.assert_array_equal(sample.euler_mm_deg, expected)


def test_threads_and_processes_change_no_sample():
    collector = Collector(CollectionSettings(), 1)
    alone = list(generate(collector.settings, 1, range(5)))
    with ThreadPoolExecutor(3) as pool:
        threads = list(pool.map(collector, range(5)))
    apart = {done.job: done.result() for done in run_jobs(collector, range(5), Workers(2))}
    for one, *others in zip(alone, threads, [apart[index] for index in range(5)], strict=True):
        for other in others:
            assert np.array_equal(one.image, other.image)
            assert np.array_equal(one.euler_mm_deg, other.euler_mm_deg)


def test_the_label_is_the_pose_but_for_slip_and_noise_of_the_arm():
    settings = CollectionSettings(depth=(4e-3, 6e-3), disk_radius=1e-3, friction=(1.5, 1.5))
    sensor = TacTip()
    for index in range(5):
        sample = collect(sensor, settings, 0, index)
        truth = se3.euler_from_pose(sample.truth.T_fs)
        assert truth[:3] * 1e3 == pytest.approx(sample.euler_mm_deg[:3], abs=0.4)
        assert np.degrees(truth[3:]) == pytest.approx(sample.euler_mm_deg[3:], abs=1.0)


def test_friction_stays_in_its_range_and_varies():
    frictions = [sample.friction for sample in generate(CollectionSettings(friction=(0.4, 0.6)), 0, range(6))]
    assert all(0.4 <= value <= 0.6 for value in frictions) and len(set(frictions)) == 6


def test_an_inverted_range_is_refused():
    with pytest.raises(SettingError, match="depth"):
        CollectionSettings(depth=(5e-3, 1e-3))
