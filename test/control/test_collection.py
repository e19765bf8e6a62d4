"""Data collection in closed loop with a kinematic arm: labels, order of motion, rest, stops, failures."""

import dataclasses

import numpy as np
import pytest
from collected import Look, Store
from kinematic_plant import MS, TIP_RADIUS, Plane, Plant, pointing_down

from tactile_base.settings import SettingError
from tactile_control.phases import StampedImage, StampedPose, TaskInputs
from tactile_geometry import se3
from tactile_records.collecting.geometry import contact_frame
from tactile_records.collecting.settings import (
    PHASES,
    CollectionGoal,
    CollectionMotionSettings,
    DataCollectionSettings,
    Target,
    TouchSettings,
)
from tactile_records.collecting.task import DataCollection

START = pointing_down((0.3, 0.1, TIP_RADIUS + 0.012))
POSES = [
    np.array([0.003, -0.002, 0.004, 0.2, -0.3, 0.08]),
    np.array([-0.004, 0.001, 0.0006, -0.35, 0.1, -0.05]),
    np.array([0.0, 0.0, 0.006, 0.0, 0.0, 0.0]),
]
TARGETS = [Target(number, pose * [0, 0, 1, 1, 1, 0], pose) for number, pose in enumerate(POSES, start=1)]
QUICK = DataCollectionSettings(motion=CollectionMotionSettings(settle_time=0.05))
FIRST_VISIBLE = 2e-4  # m of depth


class Bench(Plant):
    """An arm over a plane with a camera that needs `reference` images before it knows contact."""

    def __init__(self, T=START, reference=5, **kwargs) -> None:
        super().__init__(Plane(), T, time_constant=0.01, **kwargs)
        self.images = self.poses = True
        self.blind = False
        self.reference = reference
        self._inputs = TaskInputs()

    def collection_inputs(self) -> TaskInputs:
        stamp, T = self.history[-1]
        pose = StampedPose(stamp, T) if self.poses else self._inputs.sensor_pose
        image = self._inputs.image
        if self.images:
            seen = TIP_RADIUS - T[2, 3] > FIRST_VISIBLE and not self.blind
            image = StampedImage(stamp, T, seen if len(self.history) > self.reference else None)
        self._inputs = TaskInputs(sensor_pose=pose, image=image)
        return self._inputs


def frame(height=0.0) -> np.ndarray:
    T_base_surface = np.eye(4)
    T_base_surface[2, 3] = height
    return contact_frame(T_base_surface, START, TIP_RADIUS)


def collection(settings=QUICK, targets=TARGETS, T_base_f=None, height=0.0, store=None) -> DataCollection:
    euler = se3.euler_from_pose(frame(height) if T_base_f is None else T_base_f)
    settings = settings.replaced(data__frame=tuple(euler.tolist()))
    goal = CollectionGoal(samples=len(targets))
    task = DataCollection(settings, goal, store=store or Store(), look=Look())
    task.targets = list(targets)
    return task


def run(task, bench, limit_s=60.0, each=None):
    """All commands until the task is done."""
    commands = []
    for _ in range(round(limit_s * 1e9 / bench.period_ns)):
        command = task.step(bench.now_ns, bench.collection_inputs())
        commands.append(command)
        if each is not None:
            each(command)
        if command.done:
            break
        bench.step(command.twist)
    return commands


def phases(commands):
    seen = [command.phase for command in commands]
    return [phase for k, phase in enumerate(seen) if k == 0 or seen[k - 1] != phase]


def test_every_sample_is_captured_once_in_order_and_the_arm_ends_off_the_surface():
    task, bench = collection(), Bench()
    commands = run(task, bench)
    assert commands[-1].succeeded and not commands[-1].reason
    assert [capture.number for capture in task.store.captures] == [1, 2, 3]
    assert task.store.references == [False], "the image without contact is kept once"
    assert bench.depth == pytest.approx(-QUICK.motion.standoff, abs=6e-4)
    assert np.all(commands[-1].twist == 0.0)


def test_a_sample_goes_through_the_steps_of_the_papers_algorithm():
    commands = run(collection(targets=TARGETS[:1]), Bench())
    assert phases(commands) == [
        "go_to_start", "reference", "rotate", "contact", "shear", "capture", "retreat", "done",
    ]  # fmt: skip
    assert set(phases(commands)) <= set(PHASES)


def test_a_label_is_where_the_sensor_was_and_that_is_where_it_was_sent():
    task = collection()
    run(task, Bench())
    for capture in task.store.captures:
        X_fs = se3.inverse(frame()) @ capture.T_base_sensor
        np.testing.assert_allclose(se3.pose_from_euler(capture.euler), X_fs, atol=1e-12)
        np.testing.assert_allclose(capture.euler[:3], capture.target[:3], atol=6e-5)
        np.testing.assert_allclose(capture.euler[3:], capture.target[3:], atol=2e-3)


def test_an_exposure_is_kept_only_after_the_arm_has_rested():
    task, bench, kept = collection(), Bench(), []
    commands = run(task, bench, each=lambda command: kept.append(len(task.store.captures)))
    steps = round(QUICK.motion.settle_time / (bench.period_ns * 1e-9))
    for k, capture in zip(np.flatnonzero(np.diff(kept)) + 1, task.store.captures, strict=True):
        assert all(np.all(before.twist == 0.0) for before in commands[k - steps : k])
        _, T = next(item for item in bench.history if item[0] == capture.stamp_ns)
        np.testing.assert_array_equal(T, capture.T_base_sensor)


def test_the_sensor_turns_in_the_air_presses_along_the_normal_and_shears_at_depth():
    bench, log = Bench(), []

    def look(command):
        X_fs = se3.inverse(frame()) @ bench.T
        log.append((command.phase, se3.euler_from_pose(X_fs)))

    run(collection(targets=TARGETS[:1]), bench, each=look)
    for phase, euler in log:
        if phase == "rotate":
            assert euler[2] < -0.002
        if phase in ("contact", "shear"):
            np.testing.assert_allclose(euler[3:5], POSES[0][3:5], atol=5e-3)
        if phase == "contact":
            assert np.abs(euler[:2]).max() < 1e-3
        if phase in ("shear", "capture"):
            assert euler[2] == pytest.approx(POSES[0][2], abs=1e-4)


def test_speeds_stay_within_their_limits():
    motion = QUICK.motion
    for command in run(collection(), Bench()):
        v, omega = np.linalg.norm(command.twist[:3]), np.linalg.norm(command.twist[3:])
        slow = command.phase in ("contact", "shear")
        assert v <= motion.air_speed + 1e-9 and omega <= motion.air_angular_speed + 1e-9
        if slow and command.limited == "":
            assert v <= motion.contact_speed + 1e-9 and omega <= motion.contact_angular_speed + 1e-9


# what happens when an input stops, in every phase that moves the arm
MOVING = ("go_to_start", "rotate", "contact", "shear", "retreat")


@pytest.mark.parametrize("phase", [*MOVING, "touch"])
@pytest.mark.parametrize("silent", ["images", "poses"])
def test_an_input_that_stops_takes_the_twist_to_zero_within_its_limit(phase, silent):
    points = 1 if phase == "touch" else 0
    settings = dataclasses.replace(QUICK, touch=TouchSettings(points=points))
    task, bench = collection(settings, targets=TARGETS[:1]), Bench()
    last = {}

    def cut(command):
        if command.phase == phase and not last and np.linalg.norm(command.twist) > 1e-3:
            setattr(bench, silent, False)
            last["ns"] = bench.now_ns

    moving = []
    commands = run(task, bench, limit_s=20.0, each=lambda c: (cut(c), moving.append((bench.now_ns, c))))
    assert last, f"the arm never moved in {phase}"
    limits = task.settings.watchdog
    if phase == "retreat" and silent == "images":
        assert commands[-1].succeeded, "leaving the surface needs no image"
        return
    name = {"images": "image", "poses": "pose"}[silent]
    stop_ns = last["ns"] + round((limits.limits[name] + limits.ramp_time) * 1e9) + 150 * MS
    late = [command for now_ns, command in moving if now_ns > stop_ns and not command.done]
    assert late and all(np.all(command.twist == 0.0) for command in late)
    assert not commands[-1].succeeded and f"{name} is" in commands[-1].reason
    assert "limit" in commands[-1].reason


def test_a_hiccup_of_the_images_delays_but_does_not_fail():
    task, bench, state = collection(targets=TARGETS[:1]), Bench(), {"count": 0}

    def hiccup(command):
        if command.phase == "contact":
            state["count"] += 1
        bench.images = not 5 < state["count"] < 30

    commands = run(task, bench, each=hiccup)
    assert commands[-1].succeeded
    assert any("image is" in command.reason for command in commands)


@pytest.mark.parametrize("what", ["nan", "not a rotation"])
def test_a_pose_that_cannot_be_used_counts_as_not_come(what):
    task, bench = collection(targets=TARGETS[:1]), Bench()
    good, bad = bench.collection_inputs, np.full((4, 4), np.nan) if what == "nan" else 2.0 * np.eye(4)
    state = {"bad": False}

    def inputs():
        found = good()
        return (
            dataclasses.replace(found, sensor_pose=StampedPose(bench.now_ns, bad)) if state["bad"] else found
        )

    bench.collection_inputs = inputs
    commands = run(task, bench, each=lambda c: state.update(bad=state["bad"] or c.phase == "contact"))
    assert not commands[-1].succeeded
    assert "refused" in commands[-1].reason
    assert all(np.isfinite(command.twist).all() for command in commands)
    assert np.all(commands[-1].twist == 0.0)


def test_without_any_input_it_waits_at_rest_and_then_says_what_is_missing():
    task, bench = collection(), Bench()
    bench.images = False
    commands = run(task, bench, limit_s=15.0)
    assert all(np.all(command.twist == 0.0) for command in commands)
    assert commands[-1].reason == "no image has arrived within 10 s"


def test_without_a_reference_image_it_does_not_begin():
    commands = run(collection(), Bench(reference=10**6), limit_s=30.0)
    assert "no image without contact" in commands[-1].reason
    assert not {"rotate", "contact"} & set(phases(commands))


def test_stopping_in_contact_leaves_the_surface_before_it_ends():
    task, bench = collection(), Bench()

    def look(command):
        if command.phase == "shear" and np.any(command.twist != 0.0):
            task.stop("cancelled")

    commands = run(task, bench, each=look)
    assert phases(commands)[-3:] == ["stopping", "retreat", "failed"]
    assert commands[-1].reason == "cancelled" and bench.depth < -0.008


def test_a_surface_further_away_than_said_is_noticed_and_nothing_is_kept():
    task = collection(height=0.003, targets=TARGETS[1:2])
    run(task, Bench())
    assert all(capture.euler[2] < QUICK.motion.certain_depth for capture in task.store.captures)
    task = collection(height=0.005, targets=TARGETS[:1])
    commands = run(task, Bench())
    assert not task.store.captures
    assert "shows no contact at a depth of 4.0 mm" in commands[-1].reason
    assert not commands[-1].succeeded


def test_a_surface_nearer_than_said_is_noticed_before_pressing():
    task = collection(height=-0.005, targets=TARGETS[:1])
    commands = run(task, Bench(T=pointing_down((0.3, 0.1, 0.04))))
    assert not task.store.captures
    assert "shows contact 3.0 mm off the surface" in commands[-1].reason
    assert "contact" not in phases(commands)


@pytest.mark.parametrize("height", [-0.003, 0.0, 0.002])
def test_one_touch_finds_the_height(height):
    settings = dataclasses.replace(QUICK, touch=TouchSettings(points=1, search=0.006))
    task, bench = collection(settings, height=height), Bench(T=pointing_down((0.3, 0.1, 0.05)))
    commands = run(task, bench)
    assert commands[-1].succeeded, commands[-1].reason
    np.testing.assert_allclose(task.T_base_f[:3, 3], frame()[:3, 3], atol=6e-5)
    np.testing.assert_array_equal(task.store.surfaces, [task.T_base_f])
    for capture in task.store.captures:
        assert TIP_RADIUS - capture.T_base_sensor[2, 3] == pytest.approx(capture.target[2], abs=1.2e-4)


def test_four_touches_find_the_tilt():
    settings = dataclasses.replace(QUICK, touch=TouchSettings(points=4))
    tilted = np.eye(4)
    tilted[:3, :3] = se3.pose_from_euler([0, 0, 0, 0.05, -0.04, 0])[:3, :3]
    tilted[:3, 3] = [0.3, 0.1, 0.001]
    task = collection(settings, TARGETS[:1], contact_frame(tilted, START, TIP_RADIUS))
    commands = run(task, Bench())
    assert commands[-1].succeeded, commands[-1].reason
    assert np.degrees(np.arccos(-task.T_base_f[2, 2])) < 0.3
    np.testing.assert_allclose(task.T_base_f[2, 3], TIP_RADIUS, atol=6e-5)
    np.testing.assert_allclose(se3.inverse(task.T_base_f) @ task.T_base_f, np.eye(4), atol=1e-12)


def test_a_touch_that_meets_nothing_fails_with_how_far_it_looked():
    settings = dataclasses.replace(QUICK, touch=TouchSettings(points=1, search=0.002))
    task = collection(settings, height=0.005)
    commands = run(task, Bench(T=pointing_down((0.3, 0.1, 0.05))))
    assert "no contact within 2.0 mm above and below" in commands[-1].reason
    assert not task.store.captures


def test_a_blind_camera_stops_a_touch_before_it_presses_deep():
    settings = dataclasses.replace(QUICK, touch=TouchSettings(points=1, search=0.002))
    bench, depths = Bench(), []
    bench.blind = True
    run(collection(settings), bench, each=lambda c: depths.append(bench.depth))
    assert max(depths) < 0.003


def test_a_clock_that_goes_back_fails_the_task_at_rest():
    task, bench = collection(), Bench()
    run(task, bench, limit_s=1.0)
    command = task.step(bench.now_ns - 10**9, bench.collection_inputs())
    assert "clock went back" in command.reason and command.phase == "failed"


def test_an_arm_that_does_not_move_is_noticed():
    task, bench = collection(targets=TARGETS[:1]), Bench()
    bench.step = lambda twist: (
        setattr(bench, "now_ns", bench.now_ns + bench.period_ns),
        bench.history.append((bench.now_ns, bench.T.copy())),
    )
    commands = run(task, bench, limit_s=60.0)
    assert "the start was not reached within 20 s" in commands[-1].reason


def test_a_retreat_that_takes_too_long_is_told_beside_the_reason_for_it():
    task, bench = collection(), Bench()
    follow = bench.step

    def step(twist):
        follow(np.zeros(6) if task.phase == "retreat" else twist)

    bench.step = step
    commands = run(task, bench, each=lambda c: task.stop("enough") if c.phase == "capture" else None)
    assert phases(commands)[-2:] == ["retreat", "failed"]
    assert commands[-1].reason == "enough; the retreat took longer than 20 s"


def test_two_touches_are_refused():
    with pytest.raises(SettingError, match="two touches"):
        TouchSettings(points=2)


def test_a_folder_in_which_every_sample_is_there_is_done_at_once_and_nothing_moves():
    store = Store()
    store.missing = lambda samples: []
    task = DataCollection(QUICK, CollectionGoal(), store=store, look=Look())
    command = task.step(1, TaskInputs())
    assert command.done and command.succeeded and command.progress == 1.0 and np.all(command.twist == 0.0)


def test_a_surface_that_touches_have_found_before_is_not_sought_again():
    store = Store()
    store.surfaces.append(frame(0.001))
    settings = dataclasses.replace(QUICK, touch=TouchSettings(points=1))
    commands = run(collection(settings, TARGETS[:1], height=0.004, store=store), Bench())
    assert commands[-1].succeeded and "touch" not in phases(commands)
    X_fs = se3.inverse(frame(0.001)) @ store.captures[0].T_base_sensor
    np.testing.assert_allclose(se3.euler_from_pose(X_fs)[:3], POSES[0][:3], atol=1e-4)


def test_a_disk_that_is_full_ends_it_off_the_surface():
    store, bench = Store(), Bench()

    def keep(capture, image):
        raise OSError("No space left on device")

    store.keep = keep
    commands = run(collection(store=store), bench)
    assert not commands[-1].succeeded and "No space left on device" in commands[-1].reason
    assert bench.depth < -0.002


def test_without_a_folder_or_with_a_start_there_is_no_collection():
    with pytest.raises(ValueError, match="must name the folder"):
        DataCollection(QUICK, CollectionGoal())
    with pytest.raises(ValueError, match="start must be empty"):
        DataCollection(QUICK, CollectionGoal(), np.eye(4), Store(), Look())


def test_the_contact_frame_lies_a_radius_off_the_surface_with_z_into_it():
    T = frame(height=0.01)
    np.testing.assert_allclose(T[:3, 3], [0.3, 0.1, 0.01 + TIP_RADIUS], atol=1e-12)
    np.testing.assert_allclose(T[:3, :3], START[:3, :3], atol=1e-12)


def test_a_sensor_that_points_away_from_the_surface_is_an_error():
    with pytest.raises(ValueError, match="points away"):
        contact_frame(np.eye(4), np.eye(4), TIP_RADIUS)
