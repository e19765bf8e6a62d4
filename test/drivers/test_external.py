"""An arm of somebody else's nodes: what its scene may say, and what moveit_servo's status means."""

from pathlib import Path

import pytest

from tactile_drivers.servo_watch import ServoWatch, servo_trouble
from tactile_scene.external_settings import ExternalArmSettings
from tactile_scene.scene_file import SceneError, load_scene

CLOSER = "Moving closer to a singularity, decelerating"
HALT = "Very close to a singularity, emergency stop"


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


def told(watch: ServoWatch, clock: Clock, seconds: float, *status) -> None:
    """Twists and statuses at 50 Hz for so long."""
    for _ in range(round(seconds / 0.02)):
        clock.now += 0.02
        watch.told()
        if status:
            watch.hear(*status)


@pytest.mark.parametrize("code", [2, 5, 6])
def test_a_halt_is_why_the_arm_does_not_move_in_servos_own_words(code):
    assert servo_trouble(code, HALT) == (f"moveit_servo: {HALT}", "")


@pytest.mark.parametrize("code", [1, 3, 4])
def test_being_slowed_down_is_a_remark(code):
    assert servo_trouble(code, CLOSER) == ("", f"moveit_servo: {CLOSER}")


def test_a_twist_that_servo_does_not_take_is_told_with_what_may_be_wrong_with_it():
    fault, remark = servo_trouble(-1, "Invalid")
    assert fault.startswith("moveit_servo does not take the twist (its frame, ") and not remark


def test_all_well_is_nothing_and_a_code_of_the_future_a_remark():
    assert servo_trouble(0, "No warnings") == ("", "")
    assert servo_trouble(7, "") == ("", "moveit_servo: status 7")


def test_a_halt_stays_until_it_is_cleared(clock):
    watch = ServoWatch(clock)
    told(watch, clock, 0.2, 0, "No warnings")
    told(watch, clock, 0.02, 2, HALT)
    told(watch, clock, 0.2, 0, "No warnings")
    assert watch.fault == f"moveit_servo: {HALT}"
    watch.clear()
    assert not watch.fault


def test_what_servo_still_says_of_twists_from_before_a_pause_is_no_fault(clock):
    watch = ServoWatch(clock)
    for _ in range(50):  # nobody moves the arm, and servo goes on saying what it said last
        clock.now += 0.02
        watch.hear(5, "Collision detected, emergency stop")
    told(watch, clock, 0.06, 5, "Collision detected, emergency stop")
    told(watch, clock, 0.3, 0, "No warnings")
    assert not watch.fault
    clock.now += 1.0
    told(watch, clock, 0.3, 5, "Collision detected, emergency stop")
    assert "Collision" in watch.fault


def test_a_remark_is_one_of_now(clock):
    watch = ServoWatch(clock)
    told(watch, clock, 0.3, 4, "Close to a collision, decelerating")
    assert watch.remark == "moveit_servo: Close to a collision, decelerating"
    told(watch, clock, 0.6)  # no status any more
    assert not watch.remark
    told(watch, clock, 0.1, 4, "Close to a collision, decelerating")
    assert watch.remark
    clock.now += 0.2  # nobody moves it any more
    watch.hear(4, "Close to a collision, decelerating")
    assert not watch.remark


CELL = """\
arms:
  arm:
    driver: external
    driver_settings: {joint_velocities: /velocity/commands, publish_tool: true}
    kinematics: {description: ur5e}
    start: {}
"""


def test_the_scene_of_the_examples_has_the_joints_of_its_controller():
    scene = Path(__file__).parents[2] / "examples/external_arm/my_velocity_cell.yaml"
    arm = load_scene(scene).arms["arm"]
    given = arm.driver_settings
    settings = given.checked(ExternalArmSettings, given.values)
    assert settings.joint_order(arm.kinematics.names) == list(range(6)) and settings.publish_tool


def test_joints_of_a_velocity_controller_are_found_by_their_names_in_its_order():
    settings = ExternalArmSettings(joint_velocities="/v", joints=["a_c", "a_a", "a_b"], joint_prefix="a_")
    assert settings.joint_order(["a", "b", "c"]) == [2, 0, 1]
    assert ExternalArmSettings(joint_velocities="/v").joint_order(["a", "b", "c"]) == [0, 1, 2]


@pytest.mark.parametrize(
    ("right", "wrong", "message"),
    [
        ("    kinematics: {description: ur5e}\n", "", "joint_velocities: needs the arm's `kinematics`"),
        ("joint_velocities: /velocity/commands, ", "", "publish_tool: needs joint_velocities"),
        ("publish_tool: true", "zeros: 0.0", "zeros = 0 s: must be at least 0.2 s with joint_velocities"),
        (
            "publish_tool: true",
            "joint_prefix: left_, joints: [left_elbow_joint]",
            "left_shoulder_pan_joint, left",
        ),
        ("publish_tool: true", "joints: [1]", "joints"),
    ],
)
def test_settings_of_a_velocity_controller_that_do_not_fit_are_refused_with_the_line(
    tmp_path, right, wrong, message
):
    path = tmp_path / "cell.yaml"
    path.write_text(CELL)
    assert load_scene(path).arms["arm"].kinematics is not None
    assert right in CELL
    path.write_text(CELL.replace(right, wrong))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert message in str(caught.value) and str(caught.value).startswith(f"{path}:4: ")
