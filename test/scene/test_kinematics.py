"""Kinematics of known arms: against their makers' numbers, differences, and SciPy."""

import textwrap

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from tactile_geometry import se3
from tactile_scene.kinematics.arm_file import ArmFileError, load_arm
from tactile_scene.kinematics.capsules import Capsules, gaps
from tactile_scene.kinematics.chain import point_velocities

ARMS = ["panda", "fr3", "ur3e", "ur5e", "ur10e", "ur16e", "ur20", "ur30"]
TOOL = se3.pose_from_euler([0.02, -0.03, 0.12, 0.4, -0.9, 0.3])
#: xyz and roll of each joint of Panda and FR3 in the makers' URDF (franka_description, kinematics.yaml)
FRANKA = [
    ((0.0, 0.0, 0.333), 0.0),
    ((0.0, 0.0, 0.0), -np.pi / 2),
    ((0.0, -0.316, 0.0), np.pi / 2),
    ((0.0825, 0.0, 0.0), np.pi / 2),
    ((-0.0825, 0.384, 0.0), -np.pi / 2),
    ((0.0, 0.0, 0.0), np.pi / 2),
    ((0.088, 0.0, 0.0), np.pi / 2),
]
FRANKA_FLANGE = 0.107


#: d1, a2, a3, d4, d5, d6 (m) as the maker's URDFs have them (Universal_Robots_ROS2_Description,
#: config/*/default_kinematics.yaml: z of shoulder, x of forearm and wrist_1, z of wrist_1, -y of wrist_2,
#: y of wrist_3), and the speeds of the joints (deg/s) of its joint_limits.yaml and the user manuals
UR = {
    "ur3e": ((0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921), (180, 180, 180, 360, 360, 360)),
    "ur5e": ((0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996), (180,) * 6),
    "ur10e": ((0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655), (120, 120, 180, 180, 180, 180)),
    "ur16e": ((0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655), (120, 120, 180, 180, 180, 180)),
    "ur20": ((0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543), (120, 120, 150, 210, 210, 210)),
    "ur30": ((0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543), (120, 120, 150, 210, 210, 210)),
}


def within(arm, random, count=1):
    q = random.uniform(arm.lower, arm.upper, (count, len(arm.names)))
    return q[0] if count == 1 else q


def franka_pose(q):
    T = np.eye(4)
    for (xyz, roll), angle in zip(FRANKA, q, strict=True):
        step = np.eye(4)
        step[:3, :3] = (Rotation.from_euler("x", roll) * Rotation.from_euler("z", angle)).as_matrix()
        step[:3, 3] = xyz
        T = T @ step
    T[:3, 3] += FRANKA_FLANGE * T[:3, 2]
    return T


def ur_pose(name, q):
    """By origins and roll, pitch, yaw of the URDF's joints, each turning about its z."""
    d1, a2, a3, d4, d5, d6 = UR[name][0]
    origins = [
        ((0, 0, d1), (0, 0, 0)),
        ((0, 0, 0), (np.pi / 2, 0, 0)),
        ((a2, 0, 0), (0, 0, 0)),
        ((a3, 0, d4), (0, 0, 0)),
        ((0, -d5, 0), (np.pi / 2, 0, 0)),
        ((0, d6, 0), (np.pi / 2, np.pi, np.pi)),
    ]
    T = np.eye(4)
    for (xyz, rpy), angle in zip(origins, q, strict=True):
        step = np.eye(4)
        step[:3, :3] = (Rotation.from_euler("xyz", rpy) * Rotation.from_euler("z", angle)).as_matrix()
        step[:3, 3] = xyz
        T = T @ step
    return T


def pushed_by_a_millionth(arm, q, joint):
    step = np.zeros(len(q))
    step[joint] = 1e-6
    return arm.frames(q + step), arm.frames(q - step)


# ---- where the arm is ----


@pytest.mark.parametrize(
    "name, angles_deg, position",
    [
        # UR: a2 + a3, -(d4 + d6), d1 - d5 of the maker's table; Franka: sums of its drawing, and its start
        ("ur5e", [0, 0, 0, 0, 0, 0], [-0.8172, -0.2329, 0.0628]),
        ("ur5e", [0, -90, 0, -90, 0, 0], [0.0, -0.2329, 1.0794]),
        ("panda", [0, 0, 0, 0, 0, 0, 0], [0.088, 0.0, 0.926]),
        ("fr3", [0, -45, 0, -135, 0, 90, 45], [0.30689, 0.0, 0.59028]),
    ],
)
def test_the_flange_is_where_the_makers_drawings_have_it(name, angles_deg, position):
    np.testing.assert_allclose(load_arm(name).pose(np.radians(angles_deg))[:3, 3], position, atol=1e-5)


@pytest.mark.parametrize("name", ARMS)
def test_poses_are_those_of_the_makers_numbers_at_any_joint_angles(name):
    arm = load_arm(name)
    for q in within(arm, np.random.default_rng(1), 50):
        published = ur_pose(name, q) if name in UR else franka_pose(q)
        np.testing.assert_allclose(arm.pose(q), published, atol=1e-9)


@pytest.mark.parametrize("name", UR)
def test_the_joints_of_a_ur_turn_as_fast_and_as_far_as_its_maker_says(name):
    arm = load_arm(name)
    np.testing.assert_allclose(arm.velocity, np.radians(UR[name][1]), atol=1e-4)
    turns = [1.0, 1.0, 0.5, 1.0, 1.0, 10.0 if name == "ur3e" else 1.0]  # wrist 3 of a UR3e has no end
    np.testing.assert_allclose(arm.upper, 2.0 * np.pi * np.array(turns), atol=1e-3)
    np.testing.assert_allclose(arm.lower, -arm.upper)


@pytest.mark.parametrize("name", ARMS)
def test_the_jacobian_is_the_change_of_the_pose(name):
    arm = load_arm(name).with_tool(TOOL)
    for q in within(arm, np.random.default_rng(2), 10):
        J = arm.jacobian(q)
        for joint in range(len(q)):
            there, back = (frames[-1] for frames in pushed_by_a_millionth(arm, q, joint))
            np.testing.assert_allclose(se3.log(se3.inverse(back) @ there) / 2e-6, J[:, joint], atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_points_of_links_move_as_their_frames_do(name):
    arm, random = load_arm(name).with_tool(TOOL), np.random.default_rng(3)
    for q in within(arm, random, 5):
        rates, local = random.normal(size=len(q)), random.normal(size=3)
        before, after = arm.frames(q - 1e-6 * rates), arm.frames(q + 1e-6 * rates)
        for joint in range(len(q) + 1):
            moved = (after[joint] - before[joint]) @ [*local, 1.0] / 2e-6
            point = (arm.frames(q)[joint] @ [*local, 1.0])[:3]
            found = point_velocities(arm.frames(q), np.array(joint), point, rates)
            np.testing.assert_allclose(found, moved[:3], atol=1e-8)


@pytest.mark.parametrize("name", ARMS)
def test_no_link_moves_further_than_the_spans_say(name):
    arm, random = load_arm(name).with_tool(TOOL, (np.zeros(3), TOOL[:3, 3], 0.03)), np.random.default_rng(4)
    for q in within(arm, random, 50):
        step = random.normal(scale=0.2, size=len(q))
        ways = np.linalg.norm(arm.capsules(q + step).ends - arm.capsules(q).ends, axis=-1)
        assert ways.max() <= np.abs(step) @ arm.spans
    assert (
        arm.spans.max()
        < 1.5 * np.linalg.norm(np.diff(arm.frames(0.0 * arm.ready)[:, :3, 3], axis=0), axis=1).sum()
    )


# ---- joints for a pose ----


@pytest.mark.parametrize("name", ARMS)
def test_joint_angles_are_found_for_poses_that_the_arm_has(name):
    arm = load_arm(name).with_tool(TOOL)
    for q in arm.middle + 0.8 * (within(arm, np.random.default_rng(5), 8) - arm.middle):
        found = arm.reach(arm.pose(q), arm.ready)
        np.testing.assert_allclose(arm.pose(found), arm.pose(q), atol=1e-6)
        assert not arm.out_of_range(found)


def test_a_pose_out_of_reach_is_refused_with_how_near_the_arm_comes():
    arm = load_arm("ur5e")
    T = se3.pose_from_euler([2.0, 0.0, 0.1625, 0.0, np.pi / 2, 0.0])
    with pytest.raises(ValueError, match=r"out of reach of the ur5e: it comes within \d{3,4} mm"):
        arm.reach(T, arm.ready)


@pytest.mark.parametrize("name", ARMS)
def test_joints_follow_a_path_of_the_tool_without_drifting_off(name):
    arm = load_arm(name).with_tool(TOOL)
    q, T = arm.ready, arm.pose(arm.ready)
    for step in range(600):  # five seconds at 120 Hz, up to 60 mm/s and 0.3 rad/s
        phase = step / 600 * 2.0 * np.pi
        T = T @ se3.exp(
            np.array([0.06 * np.cos(phase), 0.06 * np.sin(phase), 0.02, 0.3 * np.cos(phase), 0, 0]) / 120
        )
        q = arm.follow(q, T)
        assert np.abs(se3.log(se3.inverse(arm.pose(q)) @ T)).max() < 1e-5
    assert not arm.out_of_range(q)


def test_the_seventh_joint_of_an_arm_is_used_to_stay_in_the_middle_of_the_ranges():
    arm = load_arm("panda")
    away = arm.ready + np.array([0.9, 0.0, -0.9, 0.0, 0.6, 0.0, 0.0])
    q, start = away, arm.pose(away)
    for step in range(1200):
        T = start @ se3.pose_from_euler([0.02 * np.sin(step / 10), 0, 0, 0, 0, 0])
        q = arm.follow(q, T)
    assert np.linalg.norm(q - arm.middle) < 0.9 * np.linalg.norm(away - arm.middle)
    found = arm.reach(start, away)
    assert np.linalg.norm(found - arm.middle) < 0.9 * np.linalg.norm(away - arm.middle)


# ---- distances ----

NUMBERS = st.floats(-1.0, 1.0)
POINTS = st.tuples(NUMBERS, NUMBERS, NUMBERS)


def one(start, end, radius=0.05):
    return Capsules(np.array([[start, end]], dtype=float), np.array([radius]), np.array([0]))


@given(POINTS, POINTS, POINTS, POINTS)
@settings(max_examples=60, deadline=None)
def test_gaps_are_what_an_optimizer_finds(a, b, c, d):
    found = gaps(one(a, b), one(c, d))
    a, b, c, d = map(np.array, (a, b, c, d))

    def square(st):
        return float(np.sum((a + st[0] * (b - a) - c - st[1] * (d - c)) ** 2))

    best = minimize(square, (0.5, 0.5), bounds=[(0, 1), (0, 1)], tol=1e-14).fun  # convex: one start will do
    assert found.distances[0] + 0.1 == pytest.approx(np.sqrt(best), abs=1e-4)
    assert found.distances[0] + 0.1 <= np.sqrt(best) + 1e-9
    if found.towards.any():
        reached = found.points[0] + (found.distances[0] + 0.1) * found.towards[0]
        along = gaps(one(reached, reached), one(c, d)).distances[0] + 0.1
        assert along == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    "first, second, distance",
    [
        (([0, 0, 0], [1, 0, 0]), ([0, 0.3, 0], [1, 0.3, 0]), 0.2),  # parallel
        (([0, 0, 0], [1, 0, 0]), ([2, 0, 0], [3, 0, 0]), 0.9),  # one after the other
        (([0, 0, 0], [1, 0, 0]), ([0.5, -1, 0.3], [0.5, 1, 0.3]), 0.2),  # across
        (([0, 0, 0], [1, 0, 0]), ([0.5, -1, 0], [0.5, 1, 0]), -0.1),  # through each other
        (([0, 0, 0], [0, 0, 0]), ([0, 0, 0.5], [0, 0, 0.5]), 0.4),  # two balls
    ],
)
def test_gaps_of_capsules_that_stand_in_special_ways(first, second, distance):
    assert gaps(one(*first), one(*second)).distances[0] == pytest.approx(distance, abs=1e-12)


def test_pairs_left_out_are_further_apart_than_asked():
    random = np.random.default_rng(6)
    first, second = (
        Capsules(random.uniform(-1, 1, (12, 2, 3)), random.uniform(0.01, 0.1, 12), np.zeros(12, dtype=int))
        for _ in range(2)
    )
    every, near = gaps(first, second), gaps(first, second, 0.3)
    assert 0 < near.distances.size < every.distances.size
    assert sorted(d for d in near.distances if d < 0.3) == sorted(d for d in every.distances if d < 0.3)


# ---- files ----

URDF = """
<robot name="franka">
  <link name="base"/><link name="flange"/>
  {joints}
  <joint name="mount" type="fixed">
    <origin xyz="0 0 0.107"/><parent link="link7"/><child link="flange"/>
  </joint>
</robot>
"""
JOINT = (
    '<link name="link{n}"/><joint name="joint{n}" type="{type}"><origin xyz="{x} {y} {z}" rpy="{roll} 0 0"/>'
    '<parent link="{parent}"/><child link="link{n}"/><axis xyz="{axis}"/>'
    '<limit lower="-2" upper="2" velocity="1" effort="1"/></joint>'
)
FILE = """
urdf: arm.urdf
base: base
flange: flange
acceleration: [1, 1, 1, 1, 1, 1, 1]
ready_deg: [0, 0, 0, 0, 0, 0, 0]
capsules:
  arm: {joint: joint3, from: [0, 0, 0], to: [0, 0, 0.1], radius: 0.05}
"""


def write_arm(folder, axis="0 0 1", kind="revolute", file=FILE):
    joints = "".join(
        JOINT.format(
            n=n, x=xyz[0], y=xyz[1], z=xyz[2], roll=roll, parent=f"link{n - 1}" if n > 1 else "base",
            axis=axis, type=kind if n == 4 else "revolute",
        )
        for n, (xyz, roll) in enumerate(FRANKA, 1)
    )  # fmt: skip
    (folder / "arm.urdf").write_text(URDF.format(joints=joints))
    (folder / "arm.yaml").write_text(textwrap.dedent(file))
    return folder / "arm.yaml"


def test_an_arm_is_read_from_a_urdf(tmp_path):
    arm = load_arm(write_arm(tmp_path))
    assert arm.names == tuple(f"joint{n}" for n in range(1, 8)) and arm.links.joints.tolist() == [3]
    for q in within(arm, np.random.default_rng(7), 5):
        np.testing.assert_allclose(arm.pose(q), franka_pose(q), atol=1e-12)


def test_joints_of_a_urdf_turn_about_the_axes_that_it_says(tmp_path):
    arm = load_arm(write_arm(tmp_path, axis="0 -3 4"))
    T, q = np.eye(4), within(arm, np.random.default_rng(8))
    for (xyz, roll), angle in zip(FRANKA, q, strict=True):
        step = np.eye(4)
        turn = Rotation.from_rotvec(angle * np.array([0.0, -0.6, 0.8]))
        step[:3, :3], step[:3, 3] = (Rotation.from_euler("x", roll) * turn).as_matrix(), xyz
        T = T @ step
    T[:3, 3] += FRANKA_FLANGE * T[:3, 2]
    np.testing.assert_allclose(arm.pose(q), T, atol=1e-12)


@pytest.mark.parametrize(
    "old, new, message",
    [
        ("arm.urdf", "none.urdf", "No such file"),
        ("flange: flange", "flange: link9", "no way from link 'base' to 'link9'; links: base, flange, link1"),
        ("base: base", "base: mount", "no way from link 'mount' to 'flange'"),
        ("joint3", "joint9", "capsules.arm.joint: unknown name 'joint9'"),
        ("radius: 0.05", "radius: 0", "capsules.arm.radius = 0 m: must be above 0"),
        ("acceleration: [1,", "acceleration: [0,", "joint1: velocity and acceleration must be above 0"),
        (
            "ready_deg: [0,",
            "ready_deg: [120,",
            "joint1: ready_deg = 120 must lie in its range, -114.6 to 114.6",
        ),
    ],
)
def test_a_mistake_in_an_arms_file_is_told_with_what_would_be_right(tmp_path, old, new, message):
    with pytest.raises(ArmFileError) as told:
        load_arm(write_arm(tmp_path, file=FILE.replace(old, new)))
    assert message in str(told.value) and str(tmp_path / "arm.yaml") in str(told.value)


def test_an_arm_with_a_sliding_joint_and_an_unknown_one_are_refused(tmp_path):
    with pytest.raises(ArmFileError, match="joint 'joint4' is prismatic; joints here turn or are fixed"):
        load_arm(write_arm(tmp_path, kind="prismatic"))
    with pytest.raises(ArmFileError, match=r"unknown name 'ur5' \(did you mean 'ur5e'"):
        load_arm("ur5")
