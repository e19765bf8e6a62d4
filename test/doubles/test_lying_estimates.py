"""Estimates that lie: what each kind makes of a true one."""

import numpy as np
import pytest

from tactile_doubles.lying_estimates import (
    LYING_ESTIMATES,
    REFUSED_COVARIANCES,
    Frozen,
    LyingCovariance,
    Noisy,
    drifting,
    offset,
    scaled,
    turned,
)
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

SECOND = 10**9
EULER = np.array([1e-3, 2e-3, 3e-3, 0.1, -0.2, 0.05])
COV = np.diag([1e-8] * 3 + [1e-4] * 3)


def estimate(euler=EULER):
    return PoseGaussian(se3.inverse(se3.pose_from_euler(euler)), COV)


def told(lie, seconds, given=None, arm="arm"):
    answer = lie.estimate(arm, round(seconds * SECOND), given or estimate())
    return se3.euler_from_pose(se3.inverse(answer.mean))


@pytest.mark.parametrize("name", LYING_ESTIMATES)
def test_a_lie_is_about_one_arm_from_its_beginning_on_and_no_contact_stays_none(name):
    lie, true = LYING_ESTIMATES[name](5.0, "left"), estimate()
    assert lie.estimate("left", 4 * SECOND, true) is true
    assert lie.estimate("right", 7 * SECOND, true) is true
    assert lie.estimate("left", 7 * SECOND, None) is None
    other = estimate(EULER + 1e-4)
    lied = lie.estimate("left", 8 * SECOND, other)
    assert not (np.array_equal(lied.mean, other.mean) and np.array_equal(lied.cov, other.cov))


def test_a_drift_grows_with_time():
    lie = drifting([0, 0, 1e-3, 0, 0.01, 0], begins=2.0)
    assert told(lie, 4.0) == pytest.approx(np.add(EULER, [0, 0, 2e-3, 0, 0.02, 0]))


def test_signs_scales_and_offsets_are_of_the_components_that_are_named():
    assert told(scaled(-1.0, "z beta"), 1.0) == pytest.approx(EULER * [1, 1, -1, 1, -1, 1])
    assert told(scaled(2.0), 1.0) == pytest.approx(2.0 * EULER)
    assert told(offset([0, 0, 2e-3, 0, 0, 0]), 1.0) == pytest.approx(np.add(EULER, [0, 0, 2e-3, 0, 0, 0]))
    with pytest.raises(ValueError, match="depth unknown, must be of x y z alpha beta gamma"):
        scaled(-1.0, "depth")
    with pytest.raises(ValueError, match=r"offset: must be 6 numbers .* has shape \(3,\)"):
        offset([0, 0, 1])


def test_images_that_are_turned_turn_shear_and_tilt_and_leave_depth_and_twist():
    small = np.array([1e-3, 0.0, 3e-3, 1e-3, 0.0, 0.0])
    assert told(turned(np.pi / 2), 1.0, estimate(small)) == pytest.approx(
        [0.0, 1e-3, 3e-3, 0.0, 1e-3, 0.0], abs=1e-9
    )


def test_noise_is_that_of_its_seed_and_arm():
    given = [
        told(Noisy([1e-3] * 6, seed=seed), 1.0, arm=arm)
        for seed, arm in ((1, "a"), (1, "a"), (2, "a"), (1, "b"))
    ]
    assert np.array_equal(given[0], given[1])
    assert not np.array_equal(given[0], given[2]) and not np.array_equal(given[0], given[3])
    lie = Noisy([1e-3, 0, 0, 0, 0, 0])
    errors = np.array([told(lie, 1.0) - EULER for _ in range(2000)])
    assert errors[:, 0].std() == pytest.approx(1e-3, rel=0.1) and np.abs(errors[:, 1:]).max() < 1e-12


def test_what_is_frozen_is_the_last_true_pose():
    lie = Frozen([0.0] * 6, begins=2.0)
    told(lie, 1.0, estimate(EULER + 1e-3))
    assert told(lie, 3.0) == pytest.approx(EULER + 1e-3) and told(lie, 9.0) == pytest.approx(EULER + 1e-3)
    assert told(Frozen([0.0] * 6), 3.0) == pytest.approx(EULER), "the first one where none was true"


@pytest.mark.parametrize("name", REFUSED_COVARIANCES)
def test_a_covariance_is_changed_and_the_pose_and_the_given_one_are_not(name):
    true = estimate()
    answer = LyingCovariance(REFUSED_COVARIANCES[name]).estimate("arm", SECOND, true)
    assert np.array_equal(answer.mean, true.mean) and np.array_equal(true.cov, COV)
    assert not np.array_equal(answer.cov, COV)
