"""Simulated arms with the kinematics of real ones, behind the safe command stage."""

import textwrap

import numpy as np
import pytest
from scipy.optimize import minimize

from tactile_drivers.arm_distance import Neighbour, neighbours
from tactile_drivers.safety import SafeArm
from tactile_geometry import se3
from tactile_scene.arm import ArmMode
from tactile_scene.scene_file import SceneError, load_scene
from tactile_sim.cell import Cell

SCENE = """
arms:
  left:
    base: {position: [-0.5, 0.0, 0.0]}
    start: {position: [-0.12, 0.0, 0.4], rotation_deg: [180, 0, 0]}
    kinematics: {description: panda, tool: {position: [0.0, 0.0, 0.1]}}
  right:
    base: {position: [0.5, 0.0, 0.0], rotation_deg: [0, 0, 180]}
    start: {position: [0.12, 0.0, 0.4], rotation_deg: [180, 0, 180]}
    kinematics: {description: ur5e, tool: {position: [0.0, 0.0, 0.1]}}
simulation: {rate: 120}
"""
ALONG_X = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])


class Arms:
    """The simulated arms of a scene, each behind its own stage, minding the others."""

    def __init__(self, folder, *changes, seconds_known=np.inf):
        text = textwrap.dedent(SCENE)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (folder / "cell.yaml").write_text(text)
        self.scene = load_scene(folder / "cell.yaml")
        self.cell = Cell(self.scene, stamp_ns=10**9)
        self.until_ns = 10**9 + seconds_known * 1e9
        self.last = {}
        self.safe = {}
        for name in self.cell.arms:
            safe = SafeArm(self.scene.arms[name], lambda: self.cell.stamp_ns, feels=False)
            self.safe[name] = safe
            safe.attach_driver(self.cell.arm(name))
            safe.neighbours = neighbours(self.scene, name, self.state_of, self.cell.arms)
            safe.take_state(self.cell.status(name))

    def state_of(self, name):
        if self.cell.stamp_ns <= self.until_ns:
            self.last[name] = self.cell.status(name)
        return self.last[name]

    def go(self, seconds, **velocities):
        """Ask arms for twists, in their own frames, at each step, after one of zero."""
        for name in velocities:
            self.safe[name].command(self.cell.stamp_ns, np.zeros(6))
        for _ in range(round(seconds * 120)):
            for name, twist in velocities.items():
                assert self.safe[name].command(self.cell.stamp_ns, twist) == ""
            self.cell.step()
            for name, safe in self.safe.items():
                assert safe.take_state(self.cell.status(name)) is not None

    def joints(self, name):
        return self.cell.status(name).joints

    def position(self, name):
        return self.cell.T_base_sensor(name)[:3, 3]

    def apart(self):
        left, right = (self.scene.arms[name] for name in ("left", "right"))
        return Neighbour(left, right, None).distance(self.joints("left"), self.joints("right"))


# ---- joints of a simulated arm ----


@pytest.mark.parametrize("name", ["left", "right"])
def test_the_joints_of_a_simulated_arm_are_those_of_its_pose(tmp_path, name):
    arms = Arms(tmp_path)
    chain = arms.scene.arms[name].kinematics
    for twist in ([0.03, 0.02, -0.05, 0.1, 0.2, 0.3], [-0.05, 0, 0.05, 0.3, -0.2, 0.1]):
        arms.go(0.5, **{name: np.array(twist)})
        T = arms.cell.T_base_sensor(name)
        assert np.abs(se3.log(se3.inverse(chain.pose(arms.joints(name))) @ T)).max() < 1e-5
    assert arms.cell.arm(name).mode is ArmMode.MOVING


def test_an_arm_without_kinematics_has_no_joints(tmp_path):
    arms = Arms(tmp_path, ("kinematics: {description: ur5e, tool: {position: [0.0, 0.0, 0.1]}}", ""))
    assert arms.joints("right") is None and not arms.safe["left"].neighbours


def test_a_joint_stops_before_the_end_of_its_range_and_says_so(tmp_path):
    arms = Arms(tmp_path)
    arms.go(4.5, left=np.array([0, 0, 0, 0, 0, 1.0]))  # about the flange's axis: joint 7 alone can do it
    chain, q = arms.scene.arms["left"].kinematics, arms.joints("left")
    assert not chain.out_of_range(q) and np.degrees((chain.upper - q).min()) < 2.0
    assert arms.cell.arm("left").mode is not ArmMode.FAULT
    assert "joint" in arms.safe["left"].state.limited_by
    assert np.abs(arms.safe["left"].state.twist).max() < 0.01
    arms.go(0.5, left=np.array([0, 0, 0, 0, 0, -1.0]))
    assert arms.safe["left"].state.twist[5] < -0.9


def test_an_arm_that_is_stretched_stops_before_its_singularity_and_comes_back(tmp_path):
    arms = Arms(tmp_path)
    arms.go(4.5, right=np.array([0, 0, -0.1, 0, 0, 0]))
    assert arms.safe["right"].state.limited_by == "singularity"
    assert arms.cell.arm("right").mode is not ArmMode.FAULT
    held = arms.position("right")
    arms.go(1.0, right=np.array([0, 0, 0.1, 0, 0, 0]))
    assert np.linalg.norm(arms.position("right") - held) > 0.05


def test_past_the_stage_an_arm_stops_in_fault_where_its_joints_cannot_follow(tmp_path):
    arms = Arms(tmp_path)
    cell = arms.cell
    for _ in range(5 * 120):
        cell.command("right", cell.stamp_ns, [0, 0, -0.1, 0, 0, 0])
        cell.step()
    state = cell.status("right")
    assert state.mode is ArmMode.FAULT and "near to a singularity" in state.reason
    assert not state.twist.any()


def test_a_start_out_of_reach_is_refused_with_what_to_look_at(tmp_path):
    far = ("start: {position: [0.12", "start: {position: [-0.60")
    with pytest.raises(ValueError, match=r"arm 'right': its start is out of reach of the ur5e: .*; see"):
        Arms(tmp_path, far)


@pytest.mark.parametrize(
    "new, message",
    [
        ("{description: ur6e}", r"cell.yaml:\d+: arms.right.kinematics.description: .*did you mean 'ur\d*e'"),
        ("{description: mine.yaml}", r"mine.yaml: no such arm file"),
        (
            "{description: ur5e, ready_deg: [0, 0, 200, 0, 0, 0]}",
            "elbow_joint is at 200.0 degrees",
        ),
        ("{description: ur5e, ready_deg: [0]}", "must be a list of 6"),
        ("{description: ur5e, tool_radius: 0}", "tool_radius = 0 m: must be above 0"),
    ],
)
def test_a_mistake_in_a_scenes_kinematics_is_told(tmp_path, new, message):
    with pytest.raises(SceneError, match=message):
        Arms(tmp_path, ("{description: ur5e, tool: {position: [0.0, 0.0, 0.1]}}", new))


# ---- two arms ----


@pytest.mark.parametrize("left, right", [(0.1, 0.0), (0.0, 0.1), (0.1, 0.1), (0.01, 0.1)])
def test_arms_that_come_towards_each_other_stop_before_they_are_too_near(tmp_path, left, right):
    arms = Arms(tmp_path)
    least = np.inf
    for _ in range(16):
        arms.go(0.15, left=left * ALONG_X, right=right * ALONG_X)
        least = min(least, arms.apart())
    assert 0.02 - 1e-6 < least < 0.021  # as near as they may, and no nearer
    for name, other, speed in (("left", "right", left), ("right", "left", right)):
        state = arms.safe[name].state
        assert np.abs(state.twist).max() < 0.001
        assert state.limited_by == (f"0.02 m from {other}" if speed else "")
    arms.go(0.5, left=-0.1 * ALONG_X, right=-0.1 * ALONG_X)
    assert arms.apart() > 0.1  # every way back is free


def test_an_arm_that_minds_no_other_is_not_limited_by_by_it(tmp_path):
    arms = Arms(tmp_path, ("  left:\n", "  left:\n    safety: {min_arm_distance: 0.0}\n"))
    assert not arms.safe["left"].neighbours and arms.safe["right"].neighbours
    arms.go(1.8, left=0.1 * ALONG_X)
    assert arms.apart() < 0.0
    arms.go(0.2, right=0.1 * ALONG_X)  # the other one does mind
    assert not arms.safe["right"].state.twist.any()


def test_an_arm_that_hears_nothing_of_the_other_does_not_move(tmp_path):
    arms = Arms(tmp_path, seconds_known=0.5)
    arms.go(0.5, left=0.05 * ALONG_X)
    assert arms.safe["left"].state.twist[0] == pytest.approx(0.05)
    arms.go(0.4, left=0.05 * ALONG_X)
    assert arms.safe["left"].state.limited_by == "no joints of right"
    assert not arms.safe["left"].state.twist.any()


def test_the_distance_of_arms_is_the_least_between_points_of_their_capsules(tmp_path):
    arms = Arms(tmp_path)
    found = []
    sets = [
        arms.scene.arms[name].kinematics.capsules(arms.joints(name)).moved(arms.scene.arms[name].T_world_base)
        for name in ("left", "right")
    ]
    for (a, b), r in zip(sets[0].ends, sets[0].radii, strict=True):
        for (c, d), s in zip(sets[1].ends, sets[1].radii, strict=True):

            def square(x, a=a, b=b, c=c, d=d):
                return np.sum((a + x[0] * (b - a) - c - x[1] * (d - c)) ** 2)

            best = minimize(square, (0.5, 0.5), bounds=[(0, 1), (0, 1)], tol=1e-14).fun
            found.append(np.sqrt(best) - r - s)
    assert arms.apart() == pytest.approx(min(found), abs=1e-6)
