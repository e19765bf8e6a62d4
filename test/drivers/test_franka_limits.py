"""Property: whatever is commanded, however it comes, what reaches a Franka keeps limits below the documented.

Commands are those that the double of the controller receives, 1000 a second, by the cycles that they answer;
so a machine that is late is not taken for a rough motion.
"""

import time

import numpy as np
import pytest
from franka_cell import Double, scene_file
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from real_arm import ZERO, Cell, address, mend

from tactile_drivers.franka_settings import DOCUMENTED, FR3, PANDA, largest_limits
from tactile_scene.arm import ArmMode
from tactile_scene.arm_settings import ArmLimits

pytestmark = pytest.mark.live

PERIOD = 1e-3  # s

commands = st.one_of(
    st.none(),  # missing
    st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(lambda v: np.array([*v, 0.0, 0.0, 0.0])),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3, *[st.floats(-1.0, 1.0)] * 3).map(np.array),
    st.sampled_from([ZERO, np.array([0.1, 0, 0, 0, 0, 0]), np.array([-0.1, 0, 0, 0, 0, 0])]),
)
steps = st.lists(st.tuples(commands, st.floats(0.0, 0.15), st.sampled_from([0.002, 0.01, 0.03])), max_size=8)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    pytest.importorskip("franky", reason="franky-control has no wheel for this Python or machine")
    pytest.importorskip("franky_sim", reason="franky-sim is not installed")
    double = Double(address(), tolerance=1.0, patience=0.1)
    cell = Cell(scene_file(tmp_path_factory.mktemp("franka"), double.host, state_timeout=1.0))
    yield cell, double
    cell.close()
    assert not double.close()


def run(cell, sequence):
    """Command what is asked for, each for some time (s), at some pace (s); then zero until the arm rests."""
    for twist, seconds, pace in sequence:
        end = time.monotonic() + seconds
        while True:
            if twist is None:
                cell.safe.stop("missing")
            else:
                cell.safe.command(time.time_ns(), twist, "test")
            if time.monotonic() >= end:
                break
            time.sleep(pace)
    still = (ArmMode.RESTING, ArmMode.FAULT)  # a fault where the machine was late
    cell.until(lambda: (cell.command(ZERO), cell.state.mode in still)[1], "rest")


@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(sequence=steps)
def test_steps_jitter_and_missing_commands_exceed_no_limit_at_the_controller(bench, sequence):
    cell, double = bench
    mend(cell, double)
    double("commands")
    run(cell, sequence)
    assert not cell.state.reason.startswith(
        "cartesian motion generator"
    )  # as the arm's controller would judge
    rows = np.array(double("commands")).reshape(-1, 7)
    if len(rows) < 3:
        return
    dt, speeds = PERIOD * np.diff(rows[:, 0]), rows[:, 1:]
    acceleration = np.diff(speeds, axis=0) / dt[:, None]
    jerk = np.diff(acceleration, axis=0) / dt[1:, None]
    limits, lever = cell.arm.limits, 0.065
    documented = DOCUMENTED[FR3]
    for part, speed, change, turning in (
        (slice(0, 3), limits.linear_velocity, limits.linear_acceleration, lever),
        (slice(3, 6), limits.angular_velocity, limits.angular_acceleration, 0.0),
    ):
        kind = part.start // 3
        speed += turning * limits.angular_velocity
        change += turning * (limits.angular_acceleration + np.sqrt(3.0) * limits.angular_velocity**2)
        norms = [np.linalg.norm(rate[:, part], axis=1).max() for rate in (speeds, acceleration, jerk)]
        print(f"{kind}: {norms[0]:.4f} {norms[1]:.3f} {norms[2]:.0f}")
        assert norms[0] <= 1.1 * np.sqrt(3.0) * speed < documented[0][kind]
        assert norms[1] <= 1.1 * np.sqrt(3.0) * change < documented[1][kind]
        assert norms[2] <= 0.5 * documented[2][kind]


@pytest.mark.parametrize("model", [FR3, PANDA])
@pytest.mark.parametrize("lever", [0.0, 0.065, 0.3])
def test_limits_that_a_scene_may_have_lie_below_those_that_are_documented(model, lever):
    """Also where all add up: axes, what rotation adds at the end effector, what the filter lets pass."""
    limits = ArmLimits(
        linear_acceleration=0.5, angular_acceleration=2.0, linear_jerk=200.0, angular_jerk=500.0
    )
    most = largest_limits(model, limits, lever)
    speeds, accelerations, jerks = DOCUMENTED[model]
    passed = 1.0 / (1.0 + 1.0 / (2.0 * np.pi * 100.0 * PERIOD))  # of a step, in the first period
    for linear, angular in ((most["linear_acceleration"], 2.0), (0.5, most["angular_acceleration"])):
        axes, whirl = np.sqrt(3.0), (np.sqrt(3.0) * limits.angular_velocity) ** 2
        assert axes * angular <= accelerations[1]
        assert axes * (500.0 + 2.0 * passed * angular / PERIOD) <= jerks[1] * (1 + 1e-9)
        if angular == 2.0:
            assert axes * (linear + angular * lever) + whirl * lever <= accelerations[0] * (1 + 1e-9)
            assert axes * (200.0 + 2.0 * passed * (linear + angular * lever) / PERIOD) <= jerks[0] * (
                1 + 1e-9
            )
    assert most["linear_velocity"] + limits.angular_velocity * lever <= speeds[0] * (1 + 1e-9)
