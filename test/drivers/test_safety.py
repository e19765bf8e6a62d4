"""The safe command stage: who may command, when, and how much of it the arm follows."""

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_drivers.safety import SafeArm
from tactile_geometry import se3
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.arm_settings import ArmLimits, Box, SafetySettings, TrackingSettings
from tactile_scene.scene_file import SceneError, load_scene
from tactile_sim.arm import SimArm

MS = 1_000_000
ME, OTHER = "/arm/controller", "/joystick"
DOWN = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
ALONG = np.array([0.0, 0.010, 0.0, 0.05, 0.0, 0.0])
LOOKING_DOWN = se3.pose_from_euler([0, 0, 0, np.pi, 0, 0])


class Follower(SimArm):
    """A driver that follows each twist at once, whatever its acceleration; commands do not grow old."""

    keeps_limits = False

    def __init__(self, limits, start, stamp_ns=0):
        super().__init__(limits, start, stamp_ns)

    def command(self, stamp_ns, twist):
        super().command(stamp_ns, twist)
        self._motion.start(twist)

    def _silence(self):
        return ""


class Cell:
    """An arm behind the stage, on one clock."""

    def __init__(
        self,
        start=None,
        driver=SimArm,
        keep_out=(),
        sensor=True,
        limits=None,
        feels=False,
        owned=True,
        protective_force=0.0,
        **safety,
    ):
        tip = SimpleNamespace(
            settings=SimpleNamespace(
                protective_depth=0.010, tip_radius=0.020, protective_force=protective_force
            )
        )
        limits = limits or ArmLimits()
        self.arm = driver(limits, np.eye(4) if start is None else start, 10**9)
        scene = SimpleNamespace(
            limits=limits,
            safety=SafetySettings(**safety),
            tracking=TrackingSettings(),
            keep_out=keep_out,
            sensor=tip if sensor else None,
        )
        self.safe = SafeArm(scene, lambda: self.arm.stamp_ns, feels=feels)
        self.safe.attach_driver(self.arm)
        self.safe.take_state(self.arm.state)
        if owned:
            self.safe.command(self.arm.stamp_ns, np.zeros(6), ME)
        self.twists = []

    @property
    def position(self):
        return self.arm.T_base_controlled[:3, 3]

    def step(self, steps=1):
        """Steps of 2 ms without a command."""
        for _ in range(steps):
            self.arm.advance(0.002)
            self.twists.append(self.arm.twist)
            self.safe.take_state(self.arm.state)

    def drive(self, twist, steps, owner=ME):
        """Command a twist before every step; the last refusal."""
        for _ in range(steps):
            refusal = self.safe.command(self.arm.stamp_ns, twist, owner)
            self.step()
        return refusal


# ---- who, and when ----


@pytest.mark.parametrize(
    "age_ms, twist, message",
    [
        (0, [0, np.nan, 0, 0, 0, 0], "not finite"),
        (0, [0, 0, 0, 0, np.inf, 0], "not finite"),
        (0, [0, 0, 0], "6 elements"),
        (150, ALONG, "0.150 s old (limit 0.1 s)"),
        (-95, ALONG, "0.095 s ahead of the clock (limit 0.02 s)"),
        (50, ALONG, "0.048 s older than the one in force"),
    ],
)
def test_a_command_that_cannot_be_meant_is_refused_and_the_one_before_stays_in_force(age_ms, twist, message):
    cell = Cell()
    cell.drive(ALONG, 300)
    assert message in cell.safe.command(cell.arm.stamp_ns - age_ms * MS, twist, ME)
    cell.step()
    np.testing.assert_allclose(cell.arm.twist, ALONG, atol=1e-12)


def test_an_arm_that_only_gets_nan_stops_and_says_why():
    cell = Cell()
    cell.drive(ALONG, 300)
    cell.drive(np.full(6, np.nan), 200)
    assert not cell.arm.twist.any()
    assert "no command for" in cell.safe.state.reason
    assert "last refused: the twist is not finite" in cell.safe.state.reason


def test_steady_speed_never_exceeds_the_limit_as_a_norm():
    cell = Cell()
    cell.drive([1.0, 1.0, 1.0, 9.0, 9.0, 9.0], 300)
    assert np.linalg.norm(cell.arm.twist[:3]) == pytest.approx(0.1)
    assert np.linalg.norm(cell.arm.twist[3:]) == pytest.approx(1.0)
    assert cell.safe.state.limited and cell.safe.state.limited_by == "speed"


def test_an_arm_obeys_one_commander_until_that_one_has_been_silent():
    cell = Cell()
    cell.drive(ALONG, 100)
    assert "is commanded by /arm/controller, not by /joystick" in cell.drive(-ALONG, 50, OTHER)
    assert cell.safe.state.owner == ME
    cell.step(100)
    assert "is commanded by" in cell.drive(-ALONG, 1, OTHER)
    cell.step(200)
    assert "waits for a twist of zero, as from every new commander" in cell.drive(-ALONG, 300, OTHER)
    assert cell.safe.state.owner == ME and not cell.arm.twist.any()
    assert cell.drive(np.zeros(6), 1, OTHER) == "" and cell.drive(-ALONG, 100, OTHER) == ""
    assert cell.safe.state.owner == OTHER
    assert "is commanded by /joystick" in cell.drive(ALONG, 1)


def test_a_stray_command_that_is_refused_does_not_lock_the_commander_out():
    cell = Cell(owned=False)
    assert "ahead of the clock" in cell.safe.command(cell.arm.stamp_ns + 95 * MS, 0 * ALONG, OTHER)
    assert cell.drive(0 * ALONG, 1) == "" and cell.drive(ALONG, 100) == ""
    np.testing.assert_allclose(cell.arm.twist, ALONG, atol=1e-12)


def test_before_a_driver_and_before_its_first_state_nothing_is_followed():
    cell = Cell()
    cell.safe.attach_driver(None)
    assert cell.drive(ALONG, 1) == "nobody drives the arm yet"
    cell.safe.attach_driver(cell.arm)
    assert cell.safe.command(cell.arm.stamp_ns, ALONG, ME) == "the arm has no state yet"


# ---- emergency stop, fault, reset ----


@pytest.mark.parametrize("driver", [SimArm, Follower])
def test_an_emergency_stop_lasts_until_a_reset_and_nothing_goes_on_by_itself(driver):
    cell = Cell(driver=driver)
    cell.drive(ALONG, 200)
    cell.safe.estop("hand in the cell")
    where = cell.position
    assert "emergency stop: hand in the cell" in cell.drive(ALONG, 100)
    assert not cell.arm.twist.any()
    assert np.linalg.norm(cell.position - where) < 0.001
    assert cell.safe.state.mode is ArmMode.ESTOP and "hand in the cell" in cell.safe.state.reason
    where = cell.position
    cell.safe.reset()
    assert "waits for a twist of zero" in cell.drive(ALONG, 500)  # whoever never stopped asking
    assert (cell.position == where).all()
    assert cell.drive(np.zeros(6), 1) == ""
    assert cell.drive(ALONG, 200) == ""
    assert cell.safe.state.mode is ArmMode.MOVING


def test_an_emergency_stop_outlives_the_driver():
    cell = Cell()
    cell.safe.estop("")
    cell.safe.attach_driver(cell.arm)
    cell.step()
    assert "emergency stop: no reason given" in cell.drive(ALONG, 1)


def test_a_fault_of_the_arm_is_left_by_a_reset_and_a_twist_of_zero():
    cell = Cell()
    cell.drive(ALONG, 200)
    cell.arm.fault("pressed too hard")
    assert "in fault: pressed too hard" in cell.drive(ALONG, 200)
    assert cell.safe.state.mode is ArmMode.FAULT and not cell.arm.twist.any()
    cell.safe.reset()
    cell.step()
    assert "waits for a twist of zero" in cell.drive(ALONG, 1)
    cell.step(300)  # silence does not take its place
    assert "waits for a twist of zero" in cell.drive(ALONG, 1)
    assert cell.drive(np.zeros(6), 1) == "" and cell.drive(ALONG, 100) == ""


def test_a_fault_that_the_arm_does_not_leave_says_why_and_an_emergency_stop_stays():
    class Stuck(SimArm):
        def recover(self):
            raise RuntimeError("the safety door is open")

    cell = Cell(driver=Stuck)
    cell.arm.fault("protective stop")
    cell.step()
    cell.safe.estop("button")
    with pytest.raises(RuntimeError, match="door is open"):
        cell.safe.reset()
    cell.step()
    assert cell.safe.state.mode is ArmMode.ESTOP and "emergency stop" in cell.drive(ALONG, 1)


def estopped(cell):
    cell.safe.estop("asked for")


def halted(cell):
    cell.safe.halt("its node was deactivated")


def faulty(cell):
    cell.arm.fault("it touched something")


@pytest.mark.parametrize("end", [estopped, halted, faulty])
def test_an_arm_that_was_stopped_is_not_moved_by_the_stop_of_a_commander_that_falls_silent(end):
    cell = Cell(driver=Follower)
    cell.drive(ALONG, 300)
    end(cell)
    cell.step(200)
    assert not cell.arm.twist.any()
    where = cell.position.copy()
    cell.safe.stop("no command for 0.116 s")
    cell.step(200)
    np.testing.assert_array_equal(cell.position, where)


def resting(cell):
    cell.step()


def moving(cell):
    cell.drive(ALONG, 100)


def stopping(cell):
    moving(cell)
    cell.step(52)


def in_fault(cell):
    moving(cell)
    cell.arm.fault("pressed too hard")
    cell.step()


STATES = {"RESTING": resting, "MOVING": moving, "STOPPING": stopping, "FAULT": in_fault}


@pytest.mark.parametrize("state", STATES)
def test_an_emergency_stop_is_obeyed_in_every_state(state):
    cell = Cell()
    STATES[state](cell)
    assert cell.safe.state.mode is ArmMode[state]
    cell.safe.estop("button")
    assert "emergency stop" in cell.drive(ALONG, 100)
    assert cell.safe.state.mode is ArmMode.ESTOP and not cell.arm.twist.any()
    cell.safe.reset()
    cell.step()
    assert cell.drive(np.zeros(6), 1) == "" and cell.drive(ALONG, 100) == ""


@pytest.mark.parametrize("state", ["RESTING", "MOVING", "STOPPING"])
def test_a_fault_of_the_arm_is_told_in_every_state(state):
    cell = Cell()
    STATES[state](cell)
    cell.arm.fault("pressed too hard")
    cell.step()
    assert cell.safe.state.mode is ArmMode.FAULT
    assert "in fault: pressed too hard" in cell.drive(ALONG, 1)


def test_an_arm_rests_after_a_twist_of_zero_and_after_silence_and_a_stop_gives_way_to_a_command():
    cell = Cell()
    moving(cell)
    cell.drive(np.zeros(6), 100)
    assert cell.safe.state.mode is ArmMode.RESTING and cell.safe.state.reason == ""
    stopping(cell)
    assert "no command for" in cell.safe.state.reason
    moving(cell)
    assert cell.safe.state.mode is ArmMode.MOVING and cell.safe.state.reason == ""
    cell.step(200)
    assert cell.safe.state.mode is ArmMode.RESTING and "no command for" in cell.safe.state.reason


# ---- states that cannot be true ----


def changed(state, **changes):
    return ArmState(**{**vars(state), **changes})


@pytest.mark.parametrize(
    "forged, why",
    [
        ({"T_base_controlled": np.full((4, 4), np.nan)}, "not finite"),
        ({"T_base_controlled": np.diag([1.0, 1.0, -1.0, 1.0])}, "not a rigid transform"),
        (
            {"T_base_controlled": se3.exp(np.array([0, 0.14, 0, 0, 0, 0]))},
            "moved by 140.0 mm in",
        ),
        ({"twist": np.full(6, np.inf)}, "twist is not finite"),
        ({"joints": np.array([0.1, np.nan])}, "joints are not finite"),
        ({"stamp_ns": 5}, "older than the last one"),
    ],
)
def test_a_state_that_cannot_be_true_is_refused_and_changes_nothing(forged, why):
    cell = Cell()
    cell.step(5)
    before = cell.safe.state
    assert cell.safe.take_state(changed(cell.arm.state, **forged)) is None
    assert why in cell.safe.bad_state
    assert cell.safe.state is before
    cell.step()
    assert cell.safe.bad_state == ""


# ---- depth, shear, workspace, boxes ----


def touching(cell, depth=0.003, shear=0.0):
    """The contact at the arm's present pose."""
    X_fs = se3.pose_from_euler([shear, 0, depth, 0.05, -0.03, 0.2])
    cell.safe.take_contact(cell.arm.stamp_ns, se3.inverse(X_fs))
    return cell.arm.T_base_controlled @ se3.inverse(X_fs)


def depth_in(T_base_feature, cell):
    return (se3.inverse(T_base_feature) @ cell.arm.T_base_controlled)[2, 3]


def keep(cell, T_base_feature):
    """The same contact, believed again."""
    X_sf = se3.inverse(cell.arm.T_base_controlled) @ T_base_feature
    cell.safe.take_contact(cell.arm.stamp_ns, X_sf)


@pytest.mark.parametrize("driver", [SimArm, Follower])
@pytest.mark.parametrize("speed", [0.004, 0.03, 0.09, 1.0])
def test_no_command_takes_the_skin_deeper_than_the_protective_depth(driver, speed):
    cell = Cell(LOOKING_DOWN, driver)
    surface = touching(cell)
    deepest = 0.0
    for _ in range(3000):
        keep(cell, surface)
        cell.drive(speed * DOWN, 1)
        deepest = max(deepest, depth_in(surface, cell))
    assert 0.0095 < deepest < 0.0101
    assert "depth 0.01 m" in cell.safe.state.limited_by
    assert cell.drive(-0.02 * DOWN, 200) == "" and depth_in(surface, cell) < 0.007  # the way out is open


@pytest.mark.parametrize("driver", [SimArm, Follower])
def test_a_sensor_that_is_pressed_too_hard_goes_no_further_in_and_may_go_out_and_along(driver):
    """Of a stiff skin, 3 N a mm: less than the depth allows."""
    cell = Cell(LOOKING_DOWN, driver, protective_force=12.0, feels=True)
    surface = touching(cell)

    def press(twist, steps):
        depths = []
        for _ in range(steps):
            keep(cell, surface)
            depths.append(depth_in(surface, cell))
            cell.safe.take_force(cell.arm.stamp_ns, np.array([0.0, 0.0, -3e3 * max(0.0, depths[-1])]))
            cell.drive(twist, 1)
        return depths

    deepest = max(press(0.02 * DOWN, 1500))
    assert 0.004 < deepest < 0.0046
    assert "force 12 N" in cell.safe.state.limited_by
    before = cell.position.copy()
    press(0.01 * DOWN + 0.01 * np.eye(6)[0], 100)
    assert np.linalg.norm(cell.position[:2] - before[:2]) > 0.001  # along the surface it goes on
    assert press(-0.02 * DOWN, 200)[-1] < 0.003


def test_a_force_that_nobody_tells_any_more_bounds_for_a_while_and_no_longer():
    cell = Cell(contact_memory=0.1, protective_force=12.0, feels=True)
    touching(cell, 0.001)
    cell.safe.take_force(cell.arm.stamp_ns, np.array([0.0, 0.0, -20.0]))
    cell.drive(0.01 * DOWN, 8)
    assert cell.position[2] < 1e-4
    for _ in range(200):
        cell.safe.take_contact(cell.arm.stamp_ns, None)
        cell.drive(0.01 * DOWN, 1)
    assert cell.position[2] > 0.001


def test_a_belief_bounds_the_motion_for_a_while_and_no_longer():
    cell = Cell(contact_memory=0.1)
    touching(cell, 0.0099)
    cell.drive(0.03 * DOWN, 45)
    assert cell.position[2] < 0.0002
    cell.drive(0.03 * DOWN, 100)
    assert cell.position[2] > 0.002
    touching(cell, 0.0099)
    cell.safe.take_contact(cell.arm.stamp_ns, None)  # nothing touches any more
    where = cell.position[2]
    cell.drive(0.03 * DOWN, 100)
    assert cell.position[2] > where + 0.003


def test_shear_is_bounded_outwards_and_free_inwards():
    cell = Cell(largest_shear=0.006)
    surface = touching(cell, shear=0.002)
    sideways = surface[:3, 0] * 0.05
    for _ in range(1000):
        keep(cell, surface)
        cell.drive([*sideways, 0, 0, 0], 1)
    shear = (se3.inverse(surface) @ cell.arm.T_base_controlled)[:2, 3]
    assert 0.0055 < np.linalg.norm(shear) < 0.0061
    cell.drive([*-sideways, 0, 0, 0], 100)
    assert np.linalg.norm((se3.inverse(surface) @ cell.arm.T_base_controlled)[:2, 3]) < 0.003


@given(
    st.lists(st.tuples(*[st.floats(-1, 1)] * 3, st.integers(1, 120)), min_size=1, max_size=12), st.booleans()
)
def test_whatever_is_commanded_the_arm_stays_in_its_workspace_and_out_of_boxes(commands, follower):
    box = Box("vice", np.array([0.02, -0.05, -0.05]), np.array([0.06, 0.05, 0.05]))
    cell = Cell(
        LOOKING_DOWN,
        Follower if follower else SimArm,
        [box],
        workspace_lower=(-0.05, -0.04, -0.03),
        workspace_upper=(0.2, 0.04, 0.03),
    )
    # the tip has a radius of 20 mm, so its centre starts at the edge of what is left of the box
    for x, y, z, steps in commands:
        for _ in range(steps):
            cell.drive([x, y, z, 0, 0, 0], 1)
            p = cell.position
            assert (p > np.array([-0.05, -0.04, -0.03]) - 0.0004).all()
            assert (p < np.array([0.2, 0.04, 0.03]) + 0.0004).all()
            assert np.linalg.norm(p - np.clip(p, box.lower, box.upper)) > 0.020 - 0.0004


def test_an_arm_outside_its_workspace_may_only_come_back():
    cell = Cell(workspace_upper=(0.2, 0.2, -0.01))
    cell.drive(0.05 * DOWN, 100)
    assert cell.position[2] == 0.0 and cell.safe.state.limited_by == "workspace z <= -0.01 m"
    cell.drive(-0.05 * DOWN, 100)
    assert cell.position[2] < -0.005


# ---- drivers that keep no limits themselves ----


def test_a_driver_without_limits_of_its_own_is_given_twists_within_those_of_acceleration_and_jerk():
    limits = ArmLimits()
    cell = Cell(driver=Follower, limits=limits)
    rng = np.random.default_rng(3)
    for _ in range(30):
        cell.drive(rng.uniform(-0.3, 0.3, 6), int(rng.integers(1, 60)))
    cell.safe.stop("enough")
    cell.step(200)
    velocity = np.array(cell.twists)
    acceleration = np.diff(velocity, axis=0) / 0.002
    jerk = np.diff(acceleration, axis=0) / 0.002
    assert np.abs(velocity[:, :3]).max() <= 0.1 * (1 + 1e-9)
    assert np.abs(acceleration[:, :3]).max() <= limits.linear_acceleration * (1 + 1e-6)
    assert np.abs(jerk[:, :3]).max() <= limits.linear_jerk * (1 + 1e-6)
    assert not cell.arm.twist.any() and cell.safe.state.reason == "enough"


# ---- what a scene says ----


def scene_text(safety="{}", keep_out="{}"):
    return f"arms:\n  arm:\n    start: {{}}\n    safety: {safety}\n    keep_out: {keep_out}\n"


def test_a_scene_says_the_workspace_and_what_is_kept_out(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text(
        scene_text("{workspace_upper: [1, 1, 0.5]}", "{vice: {lower: [0, 0, 0], upper: [0.1, 0.1, 0.2]}}")
    )
    arm = load_scene(path).arms["arm"]
    assert arm.safety.workspace_upper == (1.0, 1.0, 0.5)
    assert arm.keep_out[0].name == "vice" and arm.keep_out[0].upper.tolist() == [0.1, 0.1, 0.2]


@pytest.mark.parametrize(
    "text, complaint",
    [
        (scene_text("{workspace_upper: [1, 1, -3]}"), "workspace_lower must be below workspace_upper"),
        (scene_text("{workspace_uper: [1, 1, 1]}"), "did you mean 'workspace_upper'"),
        (scene_text(keep_out="{vice: {lower: [0, 0, 0], upper: [0, 1, 1]}}"), "lower must be below upper"),
        (scene_text(keep_out="{vice: {lower: [0, 0, 0]}}"), "upper"),
    ],
)
def test_a_workspace_that_means_nothing_is_refused_with_file_and_line(tmp_path, text, complaint):
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    with pytest.raises(SceneError, match=r"cell\.yaml:") as error:
        load_scene(path)
    assert complaint in str(error.value)
