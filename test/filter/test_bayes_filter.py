"""The filter: what it believes, what it refuses and says so, and that its covariance means what it claims."""

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from contact_case import CONTACT, COV, SIGMA
from fusion_cases import extreme_covariance, extreme_mean
from scipy.stats import chi2

from tactile_base.settings import SettingError
from tactile_filter.bayes_filter import (
    BeliefFlag,
    ContactFilter,
    FilterSettings,
    gate_threshold,
)
from tactile_filter.contact_bounds import TACTIP
from tactile_filter.fusion import MODES, fuse
from tactile_filter.propagation import innovation
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian

MS = 1_000_000
PERIOD = 16 * MS
UNGATED = FilterSettings(gate_probability=1.0)


def estimate(mean=CONTACT, cov=COV):
    return PoseGaussian(mean, cov)


def perturbed(mean, sigma, rng):
    return se3.exp(sigma * rng.normal(size=6)) @ mean


def running_filter(settings=None, steps=3):
    """A filter that has seen this many consistent estimates, the last at stamp (steps - 1) * PERIOD."""
    contact_filter = ContactFilter(settings)
    for k in range(steps):
        contact_filter.step(k * PERIOD, estimate(), np.eye(4))
    return contact_filter


def is_positive_definite(cov):
    return (
        np.array_equal(cov, cov.T)
        and np.linalg.eigvalsh(cov / np.sqrt(np.outer(np.diag(cov), np.diag(cov))))[0] > 0
    )


def test_first_measurement_is_the_belief():
    belief = ContactFilter().step(5, estimate(), np.eye(4))
    np.testing.assert_allclose(belief.mean, CONTACT, atol=1e-13)
    np.testing.assert_array_equal(belief.cov, COV)
    assert belief.flags == BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.REINITIALIZED
    assert belief.stamp_ns == 5
    assert math.isnan(belief.nis)
    assert belief.nis_dof == 0


def test_a_step_is_the_algorithm_of_the_paper():
    rng = np.random.default_rng(1)
    contact_filter = ContactFilter(UNGATED)
    first, second = perturbed(CONTACT, SIGMA, rng), perturbed(CONTACT, SIGMA, rng)
    sensor_0, sensor_1 = se3.exp([0.4, 0.1, 0.2, 0, 3.0, 0]), se3.exp([0.41, 0.1, 0.2, 0, 3.0, 0.02])
    contact_filter.step(0, estimate(first), sensor_0)
    belief = contact_filter.step(PERIOD, estimate(second), sensor_1)
    T = np.linalg.inv(sensor_1) @ sensor_0
    noise = 0.25 * np.diag([1e-6] * 3 + [math.radians(1) ** 2] * 3)
    predicted = se3.adjoint(T) @ COV @ se3.adjoint(T).T + noise
    expected = fuse(second, COV, T @ first, 0.5 * (predicted + predicted.T), "paper")
    np.testing.assert_allclose(belief.mean, expected.mean, atol=1e-13)
    np.testing.assert_allclose(belief.cov, expected.cov, rtol=1e-10, atol=1e-18)
    assert belief.flags == BeliefFlag.MEASUREMENT_FUSED
    assert belief.nis_dof == 6


def test_a_prediction_follows_the_sensors_motion_over_a_still_surface():
    contact_filter = running_filter()
    surface = CONTACT  # in the base, the sensor being at its origin
    sensor = se3.exp([0.01, 0.0, 0.002, 0.0, 0.1, 0.0])
    belief = contact_filter.predict_to(2 * PERIOD + 5 * MS, sensor)
    np.testing.assert_allclose(belief.mean, np.linalg.inv(sensor) @ surface, atol=1e-13)
    assert belief.flags == BeliefFlag.PREDICTED_ONLY
    assert belief.valid


def test_predicting_changes_nothing():
    plain, asked = running_filter(), running_filter()
    for k in range(5):
        asked.predict_to(2 * PERIOD + k, se3.exp([0.1 * k, 0, 0, 0, 0, 0.1]))
    sensor = se3.exp([1e-3, 0, 0, 0, 0, 0])
    expected = plain.step(3 * PERIOD, estimate(), sensor)
    found = asked.step(3 * PERIOD, estimate(), sensor)
    np.testing.assert_array_equal(found.mean, expected.mean)
    np.testing.assert_array_equal(found.cov, expected.cov)


def test_predictions_that_cannot_be_made_are_invalid_and_say_why():
    fresh = ContactFilter().predict_to(0, np.eye(4))
    assert not fresh.valid
    assert np.isnan(fresh.mean).all()
    assert fresh.reason == "nothing has been measured yet"
    contact_filter = running_filter()
    assert "is of 32000000 ns, which is later" in contact_filter.predict_to(PERIOD, np.eye(4)).reason
    assert (
        "no measurement fused for 0.600 s"
        in contact_filter.predict_to(2 * PERIOD + 600 * MS, np.eye(4)).reason
    )
    assert "sensor's pose" in contact_filter.predict_to(3 * PERIOD, np.full((4, 4), np.nan)).reason


def test_process_noise_is_that_of_a_step_or_grows_with_time():
    quarter = PERIOD // 4
    per_step, timed = (
        running_filter(FilterSettings(process_noise_interval=interval)) for interval in (0.0, PERIOD / 1e9)
    )
    now = 2 * PERIOD
    added = per_step.predict_to(now + quarter, np.eye(4)).cov - per_step.predict_to(now, np.eye(4)).cov
    np.testing.assert_allclose(np.diag(added)[:3], 0.5e-3**2, rtol=1e-9)
    np.testing.assert_allclose(np.diag(added)[3:], math.radians(0.5) ** 2, rtol=1e-9)
    added = timed.predict_to(now + quarter, np.eye(4)).cov - timed.predict_to(now, np.eye(4)).cov
    np.testing.assert_allclose(np.diag(added)[:3], 0.25 * 0.5e-3**2, rtol=1e-9)


def test_an_outlier_is_refused_and_the_belief_predicted():
    contact_filter = running_filter()
    before = contact_filter.predict_to(3 * PERIOD, np.eye(4))
    wild = estimate(se3.exp([0.02, 0, 0, 0, 0, 0]) @ CONTACT)
    belief = contact_filter.step(3 * PERIOD, wild, np.eye(4))
    assert belief.flags == BeliefFlag.PREDICTED_ONLY | BeliefFlag.GATED
    assert belief.nis > contact_filter.gate
    assert "above the gate 38.26" in belief.reason
    assert belief.rejected == contact_filter.rejections["outlier"] == 1
    np.testing.assert_array_equal(belief.mean, before.mean)
    np.testing.assert_array_equal(belief.cov, before.cov)


def test_without_a_gate_the_outlier_is_fused_as_in_the_paper():
    wild = estimate(se3.exp([0.02, 0, 0, 0, 0, 0]) @ CONTACT)
    belief = running_filter(UNGATED).step(3 * PERIOD, wild, np.eye(4))
    assert belief.flags & BeliefFlag.MEASUREMENT_FUSED


def test_outliers_in_a_row_start_a_new_belief():
    contact_filter = running_filter(FilterSettings(reinitialize_after=3))
    elsewhere = se3.exp([0.02, 0, 0, 0, 0, 0]) @ CONTACT
    for k in range(3):
        assert contact_filter.step((3 + k) * PERIOD, estimate(elsewhere), np.eye(4)).flags & BeliefFlag.GATED
    belief = contact_filter.step(6 * PERIOD, estimate(elsewhere), np.eye(4))
    assert belief.flags == BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.REINITIALIZED
    assert "after 3 refused in a row" in belief.reason
    np.testing.assert_allclose(belief.mean, elsewhere, atol=1e-13)
    assert contact_filter.resets["outliers in a row"] == 1


@pytest.mark.parametrize(
    ("mean", "cov", "message"),
    [
        (np.full((4, 4), np.nan), COV, "mean: is not finite"),
        (CONTACT, np.full((6, 6), np.nan), "covariance: is not finite"),
        (CONTACT, -COV, "covariance: is not positive definite: smallest eigenvalue -0.0004"),
        (CONTACT, np.diag([np.inf, 1, 1, 1, 1, 1]), "covariance: is not finite"),
        (CONTACT, COV + np.triu(np.full((6, 6), 1e-3), 1), "covariance: is not symmetric"),
        (np.diag([1.0, 1.0, 2.0, 1.0]), COV, "mean: is no pose"),
    ],
)
def test_a_measurement_that_is_no_gaussian_is_refused_counted_and_survived(mean, cov, message):
    contact_filter = running_filter()
    expected = contact_filter.predict_to(3 * PERIOD, np.eye(4))
    belief = contact_filter.step(3 * PERIOD, PoseGaussian(mean, cov), np.eye(4))
    assert message in belief.reason
    assert belief.flags == BeliefFlag.PREDICTED_ONLY
    assert contact_filter.rejections == {"not usable": 1}
    np.testing.assert_array_equal(belief.mean, expected.mean)
    assert contact_filter.step(4 * PERIOD, estimate(), np.eye(4)).flags == BeliefFlag.MEASUREMENT_FUSED


def test_a_bad_first_measurement_leaves_no_belief():
    contact_filter = ContactFilter()
    belief = contact_filter.step(0, PoseGaussian(np.full((4, 4), np.nan), COV), np.eye(4))
    assert not belief.valid
    assert not contact_filter.has_belief


def test_without_the_sensors_pose_the_belief_stays_where_it_is():
    contact_filter = running_filter()
    belief = contact_filter.step(3 * PERIOD, estimate(), np.full((4, 4), np.nan))
    assert belief.stamp_ns == 2 * PERIOD
    assert contact_filter.rejections == {"sensor pose": 1}


@pytest.mark.parametrize(
    ("offset", "reason"), [(0, "same stamp"), (-1, "out of order"), (-PERIOD, "out of order")]
)
def test_a_measurement_that_is_not_later_is_refused(offset, reason):
    contact_filter = running_filter()
    expected = contact_filter.predict_to(2 * PERIOD, np.eye(4))
    belief = contact_filter.step(2 * PERIOD + offset, estimate(), np.eye(4))
    assert belief.reason.endswith(reason)
    assert contact_filter.rejections == {reason: 1}
    assert belief.stamp_ns == 2 * PERIOD
    np.testing.assert_array_equal(belief.cov, expected.cov)


def test_time_that_jumps_back_restarts_the_filter():
    contact_filter = ContactFilter()
    contact_filter.step(100 * 1000 * MS, estimate(), np.eye(4))
    elsewhere = se3.exp([0.5, 0, 0, 0, 0, 1.0])
    belief = contact_filter.step(0, estimate(elsewhere), np.eye(4))
    assert belief.reason == "time jumped back"
    assert belief.flags == BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.REINITIALIZED
    np.testing.assert_allclose(belief.mean, elsewhere, atol=1e-13)
    assert contact_filter.resets["time jumped back"] == 1


def test_after_a_gap_the_filter_starts_from_the_measurement():
    belief = running_filter().step(2 * PERIOD + 501 * MS, estimate(), np.eye(4))
    assert belief.flags & BeliefFlag.REINITIALIZED
    assert "no measurement fused for 0.501 s, more than 0.5 s" in belief.reason


def test_reset_forgets_belief_and_counts():
    contact_filter = running_filter()
    contact_filter.step(0, estimate(), np.eye(4))
    contact_filter.reset("asked to")
    assert not contact_filter.has_belief
    assert contact_filter.rejected == 0
    assert contact_filter.resets["asked to"] == 1
    assert contact_filter.step(0, estimate(), np.eye(4)).flags & BeliefFlag.REINITIALIZED


def test_observing_an_estimate_is_a_step():
    observed, stepped = running_filter(), running_filter()
    sensor = se3.exp([1e-3, 0, 0, 0, 0, 0.01])
    found = observed.observe(3 * PERIOD, estimate(), sensor)
    expected = stepped.step(3 * PERIOD, estimate(), sensor)
    np.testing.assert_array_equal(found.mean, expected.mean)
    np.testing.assert_array_equal(found.cov, expected.cov)
    assert found.flags == expected.flags == BeliefFlag.MEASUREMENT_FUSED


def test_without_contact_the_belief_is_forgotten_once_and_the_next_contact_starts_anew():
    contact_filter = running_filter()
    for k in (3, 4):
        belief = contact_filter.observe(k * PERIOD, None, None)
        assert belief.flags == BeliefFlag.NO_CONTACT | BeliefFlag.INVALID
        assert belief.stamp_ns == k * PERIOD
        assert np.isnan(belief.mean).all() and np.isnan(belief.cov).all()
        assert all(np.isnan(vector).all() for vector in belief.vectors())
    assert contact_filter.resets == {"no contact": 1}
    assert not contact_filter.has_belief
    assert contact_filter.observe(5 * PERIOD, estimate(), np.eye(4)).flags & BeliefFlag.REINITIALIZED


def test_with_a_history_an_estimate_from_before_the_contact_was_lost_is_too_late():
    contact_filter = running_filter(FilterSettings(history=0.5))
    contact_filter.observe(4 * PERIOD, None, None)
    belief = contact_filter.observe(3 * PERIOD, estimate(), np.eye(4))
    assert "too late" in belief.reason
    assert contact_filter.late["too late"] == 1


def test_refused_measurements_are_counted_over_resets_too():
    contact_filter = ContactFilter()
    broken = estimate(cov=np.full((6, 6), np.nan))
    contact_filter.observe(0, broken, np.eye(4))
    contact_filter.observe(PERIOD, estimate(), np.eye(4))
    contact_filter.observe(2 * PERIOD, None, None)
    contact_filter.observe(3 * PERIOD, broken, np.eye(4))
    contact_filter.observe(4 * PERIOD, estimate(), None)
    assert contact_filter.rejections == {"not usable": 1, "sensor pose": 1}
    assert contact_filter.all_rejections == {"not usable": 2, "sensor pose": 1}


def test_settings_change_between_steps_and_keep_the_belief():
    contact_filter = running_filter()
    contact_filter.configure(FilterSettings(process_noise_translation=0.0, process_noise_rotation=0.0))
    still = contact_filter.predict_to(3 * PERIOD, np.eye(4)).cov
    np.testing.assert_array_equal(still, contact_filter.predict_to(2 * PERIOD, np.eye(4)).cov)


def test_more_iterations_and_orders_are_settings():
    rng = np.random.default_rng(4)
    far = estimate(se3.exp(4 * SIGMA * rng.normal(size=6)) @ CONTACT)
    answers = {}
    for mode in MODES:
        answers[mode] = (
            running_filter(UNGATED.replaced(fusion_mode=mode)).step(3 * PERIOD, far, np.eye(4)).mean
        )
    own = running_filter(UNGATED.replaced(iterations=3, jacobian_order="exact")).step(
        3 * PERIOD, far, np.eye(4)
    )
    np.testing.assert_array_equal(own.mean, answers["fast"])
    assert not np.array_equal(answers["paper"], answers["fast"])
    np.testing.assert_allclose(answers["fast"], answers["exact"], atol=1e-9)


def test_a_fusion_that_has_not_converged_is_flagged():
    turned = estimate(se3.exp([0, 0, 0, 0.6, 0.5, -0.4]) @ CONTACT)
    belief = running_filter(UNGATED.replaced(iterations=1)).step(3 * PERIOD, turned, np.eye(4))
    assert belief.flags == BeliefFlag.MEASUREMENT_FUSED | BeliefFlag.NOT_CONVERGED


def test_settings_that_contradict_each_other_are_refused():
    with pytest.raises(SettingError, match="fusion_mode 'exact' needs 'exact' or 'mode'"):
        FilterSettings(fusion_mode="exact", jacobian_order="2")
    with pytest.raises(SettingError, match="gate_probability"):
        FilterSettings(gate_probability=1.5)


def test_the_shipped_configuration_is_the_default_and_names_every_setting():
    path = Path(__file__).parents[2] / "config" / "filter.yaml"
    values = yaml.safe_load(path.read_text())
    assert FilterSettings.from_mapping(values, str(path)) == FilterSettings()
    assert set(values) == set(FilterSettings.__dataclass_fields__)


def simulate(steps, seed, settings, contact=CONTACT):
    """NIS and NEES of a filter whose model is true, over a moving sensor."""
    rng = np.random.default_rng(seed)
    contact_filter = ContactFilter(settings)
    noise = np.repeat((settings.process_noise_translation, settings.process_noise_rotation), 3)
    sensor, truth = se3.exp([0.3, 0.2, 0.1, 0.0, 3.0, 0.5]), contact
    nis, nees = [], []
    for k in range(steps):
        moved = sensor @ se3.exp(np.array([2e-4, 0, 1e-5, 2e-3, 1e-3, 2e-3]))
        truth = perturbed(se3.inverse(moved) @ sensor @ truth, noise, rng)
        sensor = moved
        belief = contact_filter.step(
            k * PERIOD, estimate(se3.exp(SIGMA * rng.normal(size=6)) @ truth), sensor
        )
        error = se3.log(truth @ se3.inverse(belief.mean))
        nees.append(error @ np.linalg.solve(belief.cov, error))
        nis.append(belief.nis)
    return np.array(nis[1:]), np.array(nees)


@pytest.mark.parametrize("mode", MODES)
def test_covariance_means_what_it_claims(mode):
    nis, nees = simulate(1500, 11, FilterSettings(fusion_mode=mode, gate_probability=1.0))
    # innovations are independent, so their sum is chi-square
    low, high = chi2.ppf((0.0005, 0.9995), 6 * len(nis))
    assert low < nis.sum() < high
    assert np.mean(nis > chi2.ppf(0.95, 6)) == pytest.approx(0.05, abs=0.02)
    # errors of the belief are correlated over a few steps: every fifth
    few = nees[5::5]
    low, high = chi2.ppf((0.0005, 0.9995), 6 * len(few))
    assert low < few.sum() < high


def test_a_gate_at_99_percent_refuses_about_one_in_a_hundred_true_measurements():
    settings = FilterSettings(gate_probability=0.99)
    nis, _ = simulate(1500, 12, settings)
    assert 0.003 < np.mean(nis > gate_threshold(0.99)) < 0.025


def test_innovation_of_a_shifted_measurement_has_its_covariance():
    shifted = PoseGaussian(se3.exp([2e-3, 0, 0, 0, 0, 0]) @ CONTACT, COV)
    nis = innovation(shifted.mean, shifted.cov, CONTACT, COV).nis
    assert nis == pytest.approx(4e-6 / (2 * SIGMA[0] ** 2), rel=1e-4)


@pytest.mark.parametrize("mode", MODES)
def test_hundreds_of_thousands_of_fusions_stay_on_the_group_and_positive_definite(mode):
    from tactile_filter import _fusion

    mean, cov, noise = CONTACT, COV, np.diag(SIGMA**2)
    rng = np.random.default_rng(9)
    observed = [perturbed(CONTACT, SIGMA, rng) for _ in range(64)]
    for k in range(300_000):
        mean, fused, _, _, status, _ = _fusion.fuse(observed[k & 63], COV, mean, cov, mode)
        cov = fused + noise
    assert np.abs(mean[:3, :3].T @ mean[:3, :3] - np.eye(3)).max() < 1e-13
    assert is_positive_definite(fused)
    assert np.linalg.norm(se3.log(mean @ se3.inverse(CONTACT)) / SIGMA) < 10
    assert status == 0


@pytest.mark.parametrize("measured", [1e-12, 1e-3, 1e12])
@pytest.mark.parametrize("noise", [0.0, 1e-9, 0.05])
def test_extreme_variances_keep_the_covariance_positive_definite(measured, noise):
    settings = FilterSettings(
        process_noise_translation=noise, process_noise_rotation=noise, gate_probability=1.0
    )
    contact_filter = ContactFilter(settings)
    cov = measured * np.eye(6)
    sensor = np.eye(4)
    for k in range(200):
        sensor = sensor @ se3.exp([0.01, 0.02, 0.0, 0.1, 0.0, 0.05])
        belief = contact_filter.step(k * PERIOD, estimate(CONTACT, cov), sensor)
        assert belief.valid
        assert is_positive_definite(belief.cov)


def test_certain_and_vague_measurements_in_turn_keep_the_covariance_positive_definite():
    contact_filter = ContactFilter(UNGATED)
    for k in range(200):
        variances = np.roll([1e-12, 1e12, 1e-6, 1.0, 1e-12, 1e6], k)
        belief = contact_filter.step(k * PERIOD, estimate(CONTACT, np.diag(variances)), np.eye(4))
        assert belief.flags & BeliefFlag.MEASUREMENT_FUSED
        assert is_positive_definite(belief.cov)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("robust", ["none", "student_t", "huber"])
def test_whatever_is_measured_a_valid_belief_is_finite_and_the_filter_goes_on(robust):
    rng, refused = np.random.default_rng(8), 0
    for run in range(60):
        contact_filter = ContactFilter(FilterSettings(robust=robust, gate_probability=1.0 - 1e-6 * (run % 2)))
        for k in range(15):
            spoilt = rng.random(3) < 0.5
            measured = PoseGaussian(
                extreme_mean(rng) if spoilt[0] else CONTACT,
                extreme_covariance(rng) if spoilt[1] else np.diag(SIGMA**2),
            )
            sensor = extreme_mean(rng) if spoilt[2] else np.eye(4)
            belief = contact_filter.step(k * PERIOD, measured, sensor)
            assert not belief.valid or (np.isfinite(belief.mean).all() and np.isfinite(belief.cov).all())
        refused += contact_filter.rejected
        good = PoseGaussian(CONTACT, np.diag(SIGMA**2))
        assert contact_filter.step(10**12, good, np.eye(4)).valid
    assert refused > 100


def test_an_estimate_that_is_the_last_one_to_the_bit_is_refused_once_the_sensor_has_moved():
    contact_filter = ContactFilter(bounds=TACTIP)
    same = PoseGaussian(CONTACT, np.diag(SIGMA**2))
    sensor = np.eye(4)
    for k in range(12):
        sensor[0, 3] = k * 1e-4
        belief = contact_filter.step(k * PERIOD, same, sensor)
        assert belief.measured == (k <= 5), f"after {k * 0.1:.1f} mm"
    assert "the same contact to the bit although the sensor has moved by 1.1 mm" in belief.reason
    new = PoseGaussian(se3.compose(se3.exp([1e-9, 0, 0, 0, 0, 0]), CONTACT), same.cov)
    assert contact_filter.step(12 * PERIOD, new, sensor).measured
