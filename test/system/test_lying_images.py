"""Cameras that lie in mid run, without ROS: the arm rests, nothing is pressed deeper, and it is said why."""

import dataclasses

import numpy as np
import pytest

from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import Task, load_task, task_path
from tactile_doubles.lying_camera import LYING_CAMERAS, ImageLies
from tactile_perception.estimating import stillness
from tactile_perception.estimating.estimator import shipped_model
from tactile_perception.estimating.image_check import ImageCheckSettings

pytestmark = pytest.mark.skipif(
    not shipped_model().is_file(), reason="the shipped model is not there: `make model` trains it"
)
REST = 0.2  # s after the lie can be known, which is at once for all of these
SAID = {
    "mirrored": "another picture at once",
    "turned_90": "another picture at once",
    "turned_180": "another picture at once",
    "frozen": "repeated: it equals the one before it bit for bit",
    "replayed": "repeated: it equals one of the last",
    "noise": "no image of the sensor",
    "black": "without contrast",
    "patch": "no image of the sensor",
}


class Deepest(ImageLies):
    """Keeps the depth of each arm when the lie began, and the deepest until `REST` and a second later."""

    def __init__(self, *arguments, **options) -> None:
        super().__init__(*arguments, **options)
        self.before: dict[str, float] = {}
        self.deepest: dict[str, float] = {}

    def see(self, cell) -> None:
        super().see(cell)
        since = (cell.stamp_ns - self.begins_ns) / SECOND_NS
        for name in cell.arms:
            if since <= 0.0:
                self.before[name] = cell.depth(name)
            if 0.0 < since < 1.0:
                self.deepest[name] = max(self.deepest.get(name, -1.0), cell.depth(name))


def rests_after(record, begins: float, speed: float = 1e-4, quiet: float = 0.5) -> float:
    """Seconds after a moment from which on an arm is no faster (m/s), for so long (s) at least."""
    since = record.arm_twist.stamp_ns / SECOND_NS - begins
    moving = np.linalg.norm(record.arm_twist.twist[:, :3], axis=1) > speed
    stops = np.flatnonzero(moving[:-1] & ~moving[1:]) + 1
    for stop in stops[since[stops] > 0.0]:
        if not moving[(since >= since[stop]) & (since < since[stop] + quiet)].any():
            return float(since[stop])
    return 0.0 if not moving[since > 0.0].any() else float("inf")


GOALS = {"dome": ("theta_1",)}


def short_push() -> Task:
    """Dual pushing to a nearer target: both arms hold the object from 5.4 s on."""
    task = load_task(task_path("dual_pushing"), "dual_pushing")
    leader, follower = task.roles
    (push,) = leader.goals
    near = dataclasses.replace(push, goal=push.goal.replaced(target=(0.18, 0.0, 0.045)))
    return dataclasses.replace(task, roles=(dataclasses.replace(leader, goals=(near,)), follower))


def run(scene: str, task: Task | str, kind: str, begins: float, arm: str = "", goals: tuple[str, ...] = ()):
    lies = Deepest(kind, begins, arm, seed=1)
    options = OfflineOptions(fidelity="image", seed=1, lies=lies, goals=goals)
    return lies, run_arms_offline(scene, task, options)


@pytest.mark.parametrize("kind", SAID)
def test_an_arm_that_follows_a_surface_rests_when_its_camera_lies_and_the_task_says_what_the_image_is(kind):
    lies, records = run("ramp", "surface_following", kind, begins=12.0)
    record = records["arm"]
    assert str(record.command.phase[record.command.stamp_ns <= 12 * SECOND_NS][-1]) == "follow"
    assert rests_after(record, 12.0) <= REST
    assert lies.witness["arm"].deepest < lies.before["arm"] + 0.0005 < 0.006
    assert not record.result["succeeded"]
    assert "tactile/image refused: " + SAID[kind] in record.result["reason"]
    assert record.result["refused"]["images refused"] > 30


@pytest.mark.parametrize("scene", ["plane", "ramp", "dome"])
def test_an_arm_that_follows_a_surface_before_a_scene_that_stands_still_but_for_noise_stops(scene):
    """After a second of images and 3 mm of way; without it the arm went on to its protective stop."""
    lies, records = run(scene, "surface_following", "frozen_noisy", begins=8.0, goals=GOALS.get(scene, ()))
    record = records["arm"]
    stopped = record.command.stamp_ns[np.isin(record.command.phase, ("stopping", "failed"))][0] / SECOND_NS
    assert 1.0 < stopped - 8.0 < 1.6
    assert lies.witness["arm"].deepest < 0.004
    assert "in contact while the images showed nothing but noise" in record.result["reason"]
    assert not record.result["succeeded"]


@pytest.mark.parametrize("kind", ["mirrored", "turned_90"])
def test_an_arm_whose_camera_is_mirrored_or_turned_from_the_start_does_not_begin(kind):
    lies, records = run("plane", "surface_following", kind, begins=0.0)
    assert lies.witness["arm"].way == 0.0
    assert "no presence has arrived within 10 s" in records["arm"].result["reason"]
    assert "reference of the contact presence refused: the picture is" in records["arm"].result["reason"]


@pytest.mark.parametrize("liar", ["leader", "follower"])
def test_of_two_arms_that_hold_an_object_both_rest_when_one_camera_lies_and_nothing_is_crushed(liar):
    lies, records = run("dual_pushing", short_push(), "frozen", begins=10.0, arm=liar)
    for name, record in records.items():
        assert rests_after(record, 10.0) <= 0.25, name
        assert lies.deepest[name] < lies.before[name] + 0.0005, name
        assert not record.result["succeeded"]
        assert "repeated: it equals the one before it bit for bit" in record.result["reason"]


@pytest.mark.parametrize("liar", ["leader", "follower"])
def test_of_two_arms_that_hold_an_object_both_go_on_when_a_camera_that_froze_for_a_moment_lives_again(liar):
    lies = ImageLies("frozen", 10.0, arm=liar, ends=10.5)
    options = OfflineOptions(fidelity="image", seed=1, lies=lies)
    records = run_arms_offline("dual_pushing", short_push(), options)
    for name, record in records.items():
        assert rests_after(record, 10.0, quiet=0.2) <= 0.25, name
        assert record.result["succeeded"], record.result["reason"]


def test_the_task_goes_on_when_a_camera_that_froze_for_a_moment_lives_again():
    lies = ImageLies("frozen", 12.0, ends=12.5)
    record = run_arms_offline("plane", options=OfflineOptions(fidelity="image", seed=1, lies=lies))["arm"]
    assert record.result["succeeded"] and record.result["refused"]["images refused"] >= 29


@pytest.mark.parametrize("kind", LYING_CAMERAS)
def test_lies_are_the_same_for_the_same_seed_and_leave_what_they_are_shown_as_it_is(kind):
    images = np.random.default_rng(2).integers(0, 255, (4, 120, 160), dtype=np.uint8)
    kept, given = images.copy(), []
    for _ in range(2):
        camera = LYING_CAMERAS[kind](seed=7)
        for image in images[:2]:
            camera.see(image)
        given.append([camera(image) for image in images[2:]])
    assert np.array_equal(given[0], given[1]) and np.array_equal(images, kept)
    assert given[0][0].shape == (120, 160) and given[0][0].dtype == np.uint8


@pytest.mark.slow
def test_an_honest_contact_that_changes_little_is_no_frozen_scene(monkeypatch):
    """Sliding along a plane with the seed whose images change least, of twenty that were tried."""
    changes = []
    close = stillness.Stillness._close

    def noted(self) -> None:
        close(self)
        changes.append(self.change)

    monkeypatch.setattr(stillness.Stillness, "_close", noted)
    record = run_arms_offline("plane", "surface_following", OfflineOptions(fidelity="image", seed=5))["arm"]
    assert record.result["succeeded"], record.result["reason"]
    known = np.array(changes)[~np.isnan(changes)]
    touched = int(np.argmax(known > 50.0))
    limit = ImageCheckSettings().still_change
    assert known[: touched - 1].max() < limit  # in the air nothing moves in the image
    lately = np.lib.stride_tricks.sliding_window_view(known[touched:], 3)  # 0.4 s, in which it goes 3 mm
    assert lately.max(axis=1).min() > 1.3 * limit
