"""Measurements and beliefs of what no sensor can feel are named, and the filter takes none of them."""

import math

import numpy as np
import pytest
from contact_case import CONTACT, COV
from hypothesis import given
from hypothesis import strategies as st

from tactile_base.settings import SettingError
from tactile_filter.bayes_filter import BeliefFlag, ContactFilter, FilterSettings
from tactile_filter.contact_bounds import TACTIP, ContactBounds
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

PERIOD = 16_000_000
SOUND = [0.004, -0.003, 0.003, 0.2, -0.1, 0.05]


def contact(x=0.0, y=0.0, z=3e-3, alpha=0.0, beta=0.0, gamma=0.0) -> np.ndarray:
    """X_sf of a surface contact pose."""
    return se3.inverse(se3.pose_from_euler([x, y, z, alpha, beta, gamma]))


def running(bounds: ContactBounds | None = TACTIP) -> ContactFilter:
    """A filter that has seen three estimates, the last at stamp 2 * PERIOD."""
    contact_filter = ContactFilter(FilterSettings(), bounds)
    for k in range(3):
        contact_filter.step(k * PERIOD, PoseGaussian(CONTACT, COV), np.eye(4))
    return contact_filter


@pytest.mark.parametrize(
    ("pose", "complaint"),
    [
        ({"x": 0.012, "y": -0.016}, "shear is 20 mm, must not exceed 15 mm"),
        ({"z": 0.02}, "depth is 20 mm, must be in [-5, 15] mm"),
        ({"z": -0.006}, "depth is -6 mm"),
        ({"x": 10.0}, "shear is 1e+04 mm"),
        ({"alpha": 1.2}, "tilt is 68.8 degrees, must not exceed 60"),
        ({"beta": -1.2}, "tilt is 68.8 degrees"),
        ({"alpha": math.pi}, "tilt is 180.0 degrees"),
        ({"gamma": -1.2}, "twist is -68.8 degrees, must not exceed 60"),
    ],
)
def test_what_cannot_be_felt_is_named_with_its_bound(pose, complaint):
    assert complaint in TACTIP.objection(contact(**pose))


@given(st.floats(0.0, 1.0), st.integers(0, 2**32 - 1))
def test_all_that_networks_are_trained_for_can_be_felt(share, seed):
    x, z, tilt, twist = (
        share * 5e-3,
        5e-4 + share * 5.5e-3,
        share * math.radians(25.0),
        share * math.radians(5.0),
    )
    direction = np.random.default_rng(seed).uniform(-np.pi, np.pi, 2)
    pose = contact(
        x * math.cos(direction[0]), x * math.sin(direction[0]), z,
        tilt * math.cos(direction[1]), tilt * math.sin(direction[1]), twist,
    )  # fmt: skip
    assert TACTIP.objection(pose) == ""


@pytest.mark.parametrize(
    ("at", "variance", "complaint"),
    [
        (0, 1e-12, "translation are 1e-06, 0.0005, 0.0002 m, must be in [1e-05, 0.05] m"),
        (5, 1e-12, "rotation are 0.008, 0.008, 1e-06 rad, must be in [0.0001, 1.5] rad"),
        (1, 1.0, "translation are 0.0005, 1, 0.0002 m"),
        (3, math.nan, "rotation are nan"),
    ],
)
def test_a_covariance_that_no_network_has_is_named(at, variance, complaint):
    cov = COV.copy()
    cov[at, at] = variance
    assert complaint in TACTIP.sigma_objection(cov)
    assert TACTIP.sigma_objection(COV) == ""


def test_bounds_that_leave_nothing_between_them_are_refused():
    with pytest.raises(SettingError, match=r"least_sigma = 0\.06: must be below largest_sigma"):
        ContactBounds(least_sigma=(0.06, 1e-4))


@pytest.mark.parametrize(
    "wrong",
    [
        PoseGaussian(contact(x=1.0), np.diag(np.full(6, 1e-12))),
        PoseGaussian(contact(z=0.02), COV),
        PoseGaussian(CONTACT, 1e-12 * np.eye(6)),
    ],
    ids=["1 m away and sure of it", "20 mm deep", "sure"],
)
def test_implausible_estimates_are_refused_however_many_come(wrong):
    contact_filter, before = running(), running().predict_to(2 * PERIOD, np.eye(4))
    for k in range(3, 33):
        belief = contact_filter.step(k * PERIOD, wrong, np.eye(4))
        assert belief.flags == BeliefFlag.PREDICTED_ONLY
        np.testing.assert_allclose(belief.mean, before.mean, atol=1e-12)
    assert contact_filter.rejections == {"not plausible": 30}
    sound = contact_filter.step(33 * PERIOD, PoseGaussian(CONTACT, COV), np.eye(4))
    assert sound.flags == BeliefFlag.MEASUREMENT_FUSED
    fresh = ContactFilter(FilterSettings(), TACTIP)
    assert not fresh.step(0, wrong, np.eye(4)).valid and not fresh.has_belief


def test_outliers_start_a_new_belief_only_where_the_contact_can_have_gone():
    """28 mm at 0.25 m/s take 112 ms."""
    start, far = PoseGaussian(contact(x=-0.014), COV), PoseGaussian(contact(x=0.014), COV)
    found = {}
    for bounds in (TACTIP, None):
        contact_filter = ContactFilter(FilterSettings(), bounds)
        contact_filter.step(0, start, np.eye(4))
        beliefs = [contact_filter.step(k * PERIOD, far, np.eye(4)) for k in range(1, 10)]
        found[bounds] = next(k for k, b in enumerate(beliefs, 1) if b.flags & BeliefFlag.REINITIALIZED)
        if bounds is not None:
            assert "the contact would have jumped by 28 mm in 96 ms" in beliefs[5].reason
    assert found == {TACTIP: 7, None: 6}


def test_within_the_bounds_beliefs_are_to_the_bit_those_without_any():
    rng = np.random.default_rng(3)
    filters = [ContactFilter(FilterSettings(), bounds) for bounds in (TACTIP, None)]
    for k in range(50):
        estimate = PoseGaussian(se3.exp(np.sqrt(np.diag(COV)) * rng.normal(size=6)) @ CONTACT, COV)
        one, other = (each.step(k * PERIOD, estimate, np.eye(4)) for each in filters)
        assert np.array_equal(one.mean, other.mean) and np.array_equal(one.cov, other.cov)
