"""Several contacts on one object: what each knows, and that together they do not claim more than that."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.stats import chi2

from tactile_filter.consistency import nees
from tactile_filter.fusion import FusionError, fuse
from tactile_filter.object.belief import (
    Contact,
    SplitGaussian,
    estimate_feature,
    fuse_contacts,
    fuse_split,
    intersection_weight,
    object_from_contact,
)
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])
COV = np.diag(SIGMA**2)
ZERO = np.zeros((6, 6))
OBJECT = se3.exp([0.5, 0.1, 0.2, 0.1, -0.3, 1.0])
# two arms on opposite sides of a box, 60 mm apart
FEATURES = {
    "left": se3.pose_from_euler([0.0, 0.03, 0.0, np.pi / 2, 0.0, 0.0]),
    "right": se3.pose_from_euler([0.0, -0.03, 0.0, -np.pi / 2, 0.0, 0.0]),
}
CONTACTS = {
    "left": se3.exp([1e-3, 0, -3e-3, 0.1, 0, 0]),
    "right": se3.exp([0, 1e-3, -2e-3, 0, 0.1, 0.05]),
}
SENSORS = {name: OBJECT @ FEATURES[name] @ se3.inverse(CONTACTS[name]) for name in FEATURES}
seeds = st.integers(0, 2**32 - 1)


def contact(name, error=None, place=None, place_cov=ZERO, cov=COV):
    belief = CONTACTS[name] if error is None else se3.exp(error) @ CONTACTS[name]
    place = FEATURES[name] if place is None else place
    return Contact(PoseGaussian(belief, cov), SENSORS[name], PoseGaussian(place, place_cov))


def fused(contacts, correlated_share=0.0, gate_probability=0.999999):
    known = {name: object_from_contact(made, correlated_share) for name, made in contacts.items()}
    return fuse_contacts(known, gate_probability)


def random_cov(rng):
    A = rng.normal(size=(6, 8))
    return 1e-6 * A @ A.T


def test_without_errors_each_contact_and_both_together_find_the_object():
    for name in FEATURES:
        np.testing.assert_allclose(object_from_contact(contact(name)).mean, OBJECT, atol=1e-13)
    both = fused({name: contact(name) for name in FEATURES})
    np.testing.assert_allclose(both.pose.mean, OBJECT, atol=1e-13)
    assert sorted(both.used) == ["left", "right"]


def test_what_a_contact_knows_has_the_covariance_of_its_errors():
    rng = np.random.default_rng(1)
    place_cov = random_cov(rng)
    place_factor = np.linalg.cholesky(place_cov)
    expected = object_from_contact(contact("left", place_cov=place_cov))
    errors = []
    for _ in range(4000):
        place = se3.exp(place_factor @ rng.normal(size=6)) @ FEATURES["left"]
        drawn = object_from_contact(contact("left", SIGMA * rng.normal(size=6), place))
        errors.append(se3.log(OBJECT @ se3.inverse(drawn.mean)))
    scale = np.sqrt(np.diag(expected.cov))
    np.testing.assert_allclose(
        np.cov(np.array(errors).T) / np.outer(scale, scale), expected.cov / np.outer(scale, scale), atol=0.08
    )


def test_the_place_of_a_contact_is_found_where_it_is():
    known = PoseGaussian(OBJECT, 1e-30 * np.eye(6))
    T_world_sensor = contact("left", np.zeros(6)).T_world_sensor
    found = estimate_feature(known, PoseGaussian(CONTACTS["left"], COV), T_world_sensor)
    np.testing.assert_allclose(found.mean, FEATURES["left"], atol=1e-13)


def errors_of_fusions(share, correlation, count=200, seed=3):
    """NEES of the object for contacts whose errors in the world are correlated, and the mean covariance."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        common = rng.normal(size=6)
        made = {}
        for name in FEATURES:
            own = np.sqrt(1 - correlation) * rng.normal(size=6) + np.sqrt(correlation) * common
            # the same error of the object for both, moved into each sensor
            to_sensor = se3.adjoint(se3.inverse(SENSORS[name]))
            made[name] = contact(name, to_sensor @ (SIGMA * own), cov=to_sensor @ COV @ to_sensor.T)
        pose = fused(made, correlated_share=share).pose
        found.append((nees(OBJECT, pose.mean, pose.cov), np.linalg.slogdet(pose.cov)[1]))
    values = np.array(found)
    return values[:, 0].sum(), values[:, 1].mean()


def test_independent_contacts_add_up_and_are_consistent():
    total, size = errors_of_fusions(share=0.0, correlation=0.0)
    low, high = chi2.ppf((0.0005, 0.9995), 6 * 200)
    assert low < total < high
    alone = np.linalg.slogdet(COV)[1]
    assert size == pytest.approx(alone - 6 * np.log(2), abs=0.1)


def test_correlated_contacts_taken_as_independent_claim_too_much_and_taken_as_correlated_do_not():
    high = chi2.ppf(0.9995, 6 * 200)
    assert errors_of_fusions(share=0.0, correlation=0.8)[0] > 1.3 * high
    assert errors_of_fusions(share=0.8, correlation=0.8)[0] < high
    assert errors_of_fusions(share=1.0, correlation=1.0)[0] < high


def test_knowing_more_of_the_correlation_gains():
    sizes = [errors_of_fusions(share, 0.0, count=3)[1] for share in (0.0, 0.5, 1.0)]
    assert sizes[0] < sizes[1] < sizes[2] + 1e-9


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_an_intersection_is_conservative_whatever_the_correlation(seed):
    """In translation alone everything is linear: the fused error's true covariance is known."""
    rng = np.random.default_rng(seed)
    A, B = random_cov(rng), random_cov(rng)
    zero = se3.exp(np.zeros(6))
    fused = fuse_split(SplitGaussian(zero, ZERO, A), SplitGaussian(zero, ZERO, B))
    w = intersection_weight(SplitGaussian(zero, ZERO, A), SplitGaussian(zero, ZERO, B))
    information = np.linalg.inv(fused.cov)
    gain_a, gain_b = fused.cov @ np.linalg.inv(A) * w, fused.cov @ np.linalg.inv(B) * (1 - w)
    np.testing.assert_allclose(information, np.linalg.inv(A) * w + np.linalg.inv(B) * (1 - w), rtol=1e-6)
    # a random cross-covariance that is possible: C = A^1/2 U B^1/2 with |U| <= 1
    U, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    C = np.linalg.cholesky(A) @ (rng.uniform() * U) @ np.linalg.cholesky(B).T
    true = gain_a @ A @ gain_a.T + gain_b @ B @ gain_b.T + gain_a @ C @ gain_b.T + gain_b @ C.T @ gain_a.T
    scale = np.sqrt(np.diag(fused.cov))
    assert np.linalg.eigvalsh((fused.cov - true) / np.outer(scale, scale))[0] > -1e-9


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.1, 1.0))
def test_the_weight_gives_the_smallest_determinant(seed, share):
    rng = np.random.default_rng(seed)
    A, B = random_cov(rng), random_cov(rng)
    a, b = (SplitGaussian(OBJECT, (1 - share) * M, share * M) for M in (A, B))

    def size(weight):
        cov = fuse(a.mean, a.weighted(weight), b.mean, b.weighted(1 - weight), "exact").cov
        return np.linalg.slogdet(cov)[1]

    best = minimize_scalar(size, bounds=(1e-6, 1 - 1e-6), method="bounded", options={"xatol": 1e-9})
    assert size(intersection_weight(a, b)) == pytest.approx(best.fun, abs=1e-6)


def test_a_place_found_by_touch_does_not_make_the_object_more_certain_than_it_was():
    """The second contact's place was found from the object's pose: it repeats what was known then."""
    rng = np.random.default_rng(5)
    total, count = {"split": 0.0, "naive": 0.0}, 150
    for _ in range(count):
        left = contact("left", SIGMA * rng.normal(size=6))
        first = object_from_contact(left).gaussian
        touch = PoseGaussian(se3.exp(0.2 * SIGMA * rng.normal(size=6)) @ CONTACTS["right"], 0.04 * COV)
        place = estimate_feature(first, touch, SENSORS["right"])
        again = PoseGaussian(se3.exp(0.2 * SIGMA * rng.normal(size=6)) @ CONTACTS["right"], 0.04 * COV)
        right = object_from_contact(Contact(again, SENSORS["right"], place))
        naive = fuse(first.mean, first.cov, right.mean, right.cov, "exact")
        known = SplitGaussian(first.mean, ZERO, first.cov)
        split = fuse_split(known, right)
        total["naive"] += nees(OBJECT, naive.mean, naive.cov)
        total["split"] += nees(OBJECT, split.mean, split.cov)
    high = chi2.ppf(0.9995, 6 * count)
    assert total["naive"] > 1.2 * high
    assert total["split"] < high


def test_three_contacts_are_fused_in_an_order_that_does_not_depend_on_their_names_order():
    rng = np.random.default_rng(6)
    made = {
        name: contact(side, SIGMA * rng.normal(size=6), cov=scale * COV)
        for name, side, scale in (("a", "left", 1.0), ("b", "right", 2.0), ("c", "left", 3.0))
    }
    one = fused(made, correlated_share=0.5).pose
    other = fused(dict(reversed(made.items())), correlated_share=0.5).pose
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.cov, other.cov)


def test_a_contact_that_disagrees_is_refused_by_name():
    made = {"left": contact("left"), "right": contact("right", 20 * SIGMA, cov=2 * COV)}
    found = fused(made)
    assert found.used == ("left",)
    assert found.refused["right"] > 38
    assert fused(made, gate_probability=1.0).used == ("left", "right")


def test_a_contact_that_is_no_gaussian_is_an_error_that_says_so():
    with pytest.raises(FusionError, match="not positive definite"):
        fused({"left": contact("left", cov=-COV), "right": contact("right")})


def test_no_contact_is_no_belief():
    assert fused({}).pose is None


def test_parts_of_the_covariance_stay_positive_semidefinite():
    rng = np.random.default_rng(7)
    fused = SplitGaussian(OBJECT, random_cov(rng), random_cov(rng))
    for _ in range(50):
        fused = fuse_split(fused, SplitGaussian(OBJECT, random_cov(rng), random_cov(rng)))
        scale = np.sqrt(np.diag(fused.cov))
        for part in (fused.independent, fused.correlated):
            assert np.linalg.eigvalsh(part / np.outer(scale, scale))[0] > -1e-12
