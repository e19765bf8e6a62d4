"""Where the tip is in the tool, from constructed touches; refused where they do not tell it."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from tactile_control.tasks.touching import TouchingGoal
from tactile_geometry import se3
from tactile_records.calibrating import tip
from tactile_records.calibrating.result import CalibrationError
from tactile_records.calibrating.touches import touches_of
from tactile_records.runs.record import PoseSeries, PresenceSeries, RunRecord

GOAL = TouchingGoal(upright=3, tilted=8, tilt_deg=30.0)
lengths = st.floats(-0.003, 0.003)


def touched(offset, goal=GOAL, noise=0.0, seed=0, normal=(0.0, 0.0, 1.0), spread=0.0):
    """Where an arm says that its sensor is (N, 4, 4) when a tip at `offset` touches a plane."""
    random = np.random.default_rng(seed)
    down = se3.pose_from_euler([0.4, -0.1, 0.3, np.pi, 0.0, 0.3])
    n = np.asarray(normal) / np.linalg.norm(normal)
    poses = []
    for place, tilt in goal.touches:
        X = se3.exp(np.concatenate([np.zeros(3), tilt]))
        X[:3, 3] = place + spread * random.normal(size=3)
        T = down @ X
        centre = T[:3, 3] + T[:3, :3] @ offset
        T[:3, 3] += n * (0.02 - n @ centre + noise * random.normal())
        poses.append(T)
    return np.array(poses)


@settings(max_examples=30, deadline=None)
@given(
    offset=st.tuples(lengths, lengths, lengths),
    slope=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    noise=st.floats(0.0, 5e-5),
    seed=st.integers(0, 1000),
)
def test_an_offset_is_found_again_within_its_uncertainty(offset, slope, noise, seed):
    found = tip.estimated(touched(np.array(offset), noise=noise, seed=seed, normal=(*slope, 1.0)))
    assume(found.along_observed)
    assert np.all(np.abs(found.offset - offset) < 5.0 * found.sigma)
    assert found.residual < 2.0 * noise + 1e-6
    np.testing.assert_allclose(found.normal[:2], slope, atol=0.02)


def test_the_uncertainty_across_is_that_of_repeated_measurements():
    errors = []
    for seed in range(60):
        found = tip.estimated(touched(np.zeros(3), noise=1e-4, seed=seed))
        errors.append(found.offset[:2] / found.sigma[:2])
    assert 0.4 < np.median(np.abs(errors)) < 1.1  # 0.73 for five touches more than unknowns


def test_tilts_that_do_not_tell_the_offset_along_the_axis_leave_it_as_it_is():
    goal = TouchingGoal(upright=4, tilted=8, tilt_deg=8.0)
    found = tip.estimated(touched(np.array([0.002, -0.001, 0.003]), goal, noise=3e-5))
    assert not found.along_observed
    assert found.offset[2] == pytest.approx(0.0, abs=1e-6)
    assert found.sigma[2] > 1e-3
    np.testing.assert_allclose(found.offset[:2], [0.002, -0.001], atol=3e-4)


UPRIGHT = TouchingGoal(upright=12)
FEW = TouchingGoal(upright=1, tilted=4)


@pytest.mark.parametrize(
    ("poses", "words"),
    [
        (touched(np.zeros(3), UPRIGHT, spread=0.003), "from at least three tilts of 15 degrees and more"),
        (touched(np.zeros(3))[[0, 1, 2, 3, 7, 3, 7, 3, 7]], "told to .* mm, must be to 0.5: touch from"),
        (touched(np.zeros(3), FEW), "5 touches: must be at least 7"),
        (np.zeros((0, 4, 4)), "0 touches: must be at least 7"),
    ],
)
def test_touches_that_do_not_tell_an_offset_are_refused_with_what_would(poses, words):
    with pytest.raises(CalibrationError, match=words):
        tip.estimated(poses)


def run(scores_of, threshold, speed=0.002, rate=60.0):
    """A run of three touches, each from 1 mm over the surface to 0.8 mm into it, and away again."""
    way = np.concatenate([np.arange(-0.001, 0.0008, speed / rate), [-0.003]])
    depth = np.concatenate([way - 1e-5 * k for k in range(3)])
    stamps = 10**9 + (np.arange(len(depth)) * 1e9 / rate).astype(np.int64)
    T = np.tile(se3.pose_from_euler([0.0, 0.0, 0.0, np.pi, 0.0, 0.0]), (len(depth), 1, 1))
    T[:, 2, 3] = 0.02 - depth
    score = scores_of(np.maximum(depth, 0.0))
    return RunRecord(pose=PoseSeries(stamps, T), presence=PresenceSeries(stamps, score, score >= threshold))


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0])
def test_the_first_contact_is_found_before_presence_tells_it(power):
    record = run(lambda depth: 0.3 * (depth / 1e-3) ** power, 0.02)
    touches = touches_of(record)
    assert len(touches) == 3
    for touch in touches:
        assert touch.T_base_sensor[2, 3] == pytest.approx(0.020, abs=1e-5)


def test_without_scores_it_is_where_presence_changed():
    touches = touches_of(run(lambda depth: (depth > 0.0).astype(float), 0.5))
    assert [t.T_base_sensor[2, 3] for t in touches] == pytest.approx([0.020] * 3, abs=0.002 / 60.0)


def test_a_run_without_contact_has_no_touches():
    assert touches_of(run(lambda depth: 0.0 * depth, 0.02)) == []
    assert touches_of(RunRecord()) == []
