"""Whether known arms can do the paper's dual-arm pushing, with what margins, and what their kinematics cost.

    python bench/arm_kinematics.py [--arms panda fr3 ur5e] [--speed 0.010] [--width 0.06]
    python bench/arm_kinematics.py --arms panda --push 1

The leader's sensor goes from (0.100, -0.250, 0.045) m, along +y, on the circle that ends in (0.375, 0.0,
0.045), the follower's faces it over an object of that width. Flanges point down and carry a right-angle
adapter, turned about the flange's axis by the one of eight angles with the best margins; bases are 1.0 m
apart and face each other. Where Pinocchio is installed (`pin`), poses and Jacobians are compared.

With `--push`, whole pushes of dual_pushing.yaml instead, in closed loop, with kinematics and without.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import time
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np

from tactile_bringup.experiment import numbers_of
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_drivers.arm import ArmLimits, ArmMode, ArmState, SafetySettings
from tactile_drivers.arm_distance import Neighbour
from tactile_drivers.joint_limits import allowed_part, joint_rates, smallest_singular_value
from tactile_drivers.kinematics.arm_file import load_arm
from tactile_drivers.kinematics.capsules import gaps
from tactile_drivers.kinematics.chain import Chain
from tactile_drivers.scene import load_scene
from tactile_drivers.sim.pushing_scene import pushing_scene
from tactile_geometry import se3

START, TARGET, HEIGHT = np.array([0.100, -0.250]), np.array([0.375, 0.0]), 0.045
TIP = 0.017  # m from the sensor's frame to the object: a tip of 20 mm pressed 3 mm deep
APART = 1.0  # m between bases
ADAPTER = (0.0, 0.0, 0.06)  # m, the right-angle adapter's tool frame in the flange
SENSOR = (0.0, 0.0, 0.065)  # m, the sensor in the tool
STEP = 1.0 / 120.0


LAYOUTS = {  # x, y (m) and heading (degrees) of the leader's base and the follower's
    "along x": ((-0.2, -0.1, 0.0), (0.8, -0.1, 180.0)),
    "along y": ((0.5, -0.6, 90.0), (0.5, 0.4, -90.0)),
}


def pushed_path(speed: float) -> np.ndarray:
    """Poses (n, 4, 4) of the leader's sensor in the world, one a step; x down, z along the way."""
    chord = TARGET - START
    bearing = np.arctan2(chord[0], chord[1])  # from +y to the right
    radius = np.linalg.norm(chord) / (2.0 * np.sin(bearing))
    turned = np.arange(0.0, 2.0 * bearing, speed * STEP / radius)
    poses = np.tile(np.eye(4), (len(turned), 1, 1))
    poses[:, 0, 3] = START[0] + radius * (1.0 - np.cos(turned))
    poses[:, 1, 3] = START[1] + radius * np.sin(turned)
    poses[:, 2, 3] = HEIGHT
    ahead = np.stack([np.sin(turned), np.cos(turned), np.zeros_like(turned)], axis=1)
    down = np.array([0.0, 0.0, -1.0])
    poses[:, :3, 0], poses[:, :3, 2] = down, ahead
    poses[:, :3, 1] = np.cross(ahead, down)
    return poses


def facing(poses: np.ndarray, width: float) -> np.ndarray:
    """Poses of a sensor that faces another over an object: turned about its x, which points down."""
    opposite = se3.pose_from_euler([0.0, 0.0, width + 2.0 * TIP, np.pi, 0.0, 0.0])
    return np.asarray(poses @ opposite)


def with_adapter(arm: Chain, turned_deg: float) -> Chain:
    """The arm with a sensor across its flange: sensor's x along the flange's z."""
    T_tool = se3.pose_from_euler([*ADAPTER, np.pi, -np.pi / 2, np.radians(turned_deg)])
    T_end = T_tool @ se3.pose_from_euler([*SENSOR, 0.0, 0.0, 0.0])
    front = T_end[:3, 3] - 0.015 * T_end[:3, 2]
    radius = 0.035
    return arm.with_tool(T_end, (np.zeros(3), T_tool[:3, 3], radius), (T_tool[:3, 3], front, radius))


def base_pose(x: float, y: float, heading_deg: float) -> np.ndarray:
    return se3.pose_from_euler([x, y, 0.0, 0.0, 0.0, np.radians(heading_deg)])


def followed(arm: Chain, poses: np.ndarray) -> np.ndarray:
    """Joint angles (n, joints) along poses in the base; ValueError if the arm cannot."""
    q = arm.reach(poses[0], arm.ready)
    path = [q]
    for T in poses[1:]:
        q = arm.follow(q, T)
        if not arm.follows(q, T) or arm.out_of_range(q):
            raise ValueError(arm.out_of_range(q) or "the joints do not follow")
        path.append(q)
    return np.array(path)


@dataclasses.dataclass
class Margins:
    """The least along a path, of one arm or of both."""

    range_deg: float
    speed_share: float
    singular: float
    floor_mm: float

    @classmethod
    def of(cls, arm: Chain, path: np.ndarray) -> Margins:
        speeds = np.abs(np.diff(path, axis=0)) / STEP / arm.velocity
        links = [arm.capsules(q) for q in path[::20]]
        moving = links[0].joints > 1  # the column stands on the floor
        floor = min(float((c.ends[moving][..., 2].min(axis=1) - c.radii[moving]).min()) for c in links)
        return cls(
            float(np.degrees(np.minimum(arm.upper - path, path - arm.lower).min())),
            float(speeds.max()),
            min(smallest_singular_value(arm, q) for q in path[::20]),
            1e3 * floor,
        )

    @property
    def least(self) -> float:
        """For a choice: in parts of what is good enough."""
        return min(self.range_deg / 15.0, self.singular / 0.04)


@dataclasses.dataclass
class Solution:
    """An arm with its adapter on its way."""

    arm: Chain
    T_world_base: np.ndarray
    turned_deg: int
    path: np.ndarray
    margins: Margins


def solve(name: str, base: tuple[float, float, float], poses: np.ndarray) -> Solution | None:
    """The best adapter for sensor poses in the world; None if the arm cannot follow them with any."""
    T_world_base, found = base_pose(*base), []
    coarse = np.concatenate([poses[::20], poses[-1:]])
    for turned in range(-180, 180, 45):
        arm = with_adapter(load_arm(name), turned)
        try:
            path = followed(arm, se3.inverse(T_world_base) @ coarse)
        except ValueError:
            continue
        found.append((Margins.of(arm, path).least, turned))
    if not found:
        return None
    turned = max(found)[1]
    arm = with_adapter(load_arm(name), turned)
    path = followed(arm, se3.inverse(T_world_base) @ poses)
    return Solution(arm, T_world_base, turned, path, Margins.of(arm, path))


def apart(first: Solution, second: Solution) -> float:
    """How near the arms come to each other, m."""
    between = se3.inverse(first.T_world_base) @ second.T_world_base
    return min(
        float(gaps(first.arm.capsules(p), second.arm.capsules(q).moved(between)).distances.min())
        for p, q in zip(first.path[::20], second.path[::20], strict=True)
    )


def as_scenes(*solutions: Solution) -> list[SimpleNamespace]:
    """What `Neighbour` wants to know of arms, with all limits at their defaults."""
    return [
        SimpleNamespace(
            name=role,
            kinematics=solution.arm,
            T_world_base=solution.T_world_base,
            limits=ArmLimits(),
            safety=SafetySettings(),
        )
        for role, solution in zip(("leader", "follower"), solutions, strict=True)
    ]


def followed_part(first: Solution, second: Solution) -> float:
    """The least part of their way's twists that the safe command stage leaves the two arms."""
    scenes, least, safety = as_scenes(first, second), 1.0, SafetySettings()
    for own, other, mine, theirs in ((first, second, *scenes), (second, first, *scenes[::-1])):
        for i in range(0, len(own.path) - 1, 20):
            states = [
                ArmState(0, np.eye(4), np.zeros(6), ArmMode.MOVING, "", solution.path[i])
                for solution in (own, other)
            ]
            q, q_next = own.path[i], own.path[i + 1]
            twist = se3.log(se3.inverse(own.arm.pose(q)) @ own.arm.pose(q_next)) / STEP
            rates = joint_rates(own.arm, q, twist)
            part, _ = allowed_part(own.arm, q, rates, 0.04, safety.singularity_slow, safety.singularity_stop)
            neighbour = Neighbour(mine, theirs, lambda states=states: states[1])
            least = min(least, part, neighbour.allowed_part(states[0], twist, rates, 0.04)[0])
    return least


def microseconds(call: Callable[[], object], repeat: int = 1000) -> float:
    """Of one call, the best of five rounds."""
    rounds = []
    for _ in range(5):
        start = time.process_time()
        for _ in range(repeat // 5):
            call()
        rounds.append((time.process_time() - start) / (repeat // 5) * 1e6)
    return min(rounds)


def costs(first: Solution, second: Solution) -> dict[str, float]:
    """Microseconds of what a step needs, at joint angles that are new each time."""
    arm, q = first.arm, first.path[0]
    random = np.random.default_rng(1)
    twist = np.array([0.01, 0.0, 0.01, 0.05, 0.0, 0.0])
    safety = SafetySettings()
    scenes = as_scenes(first, second)
    middle = len(first.path) // 2
    own, other = (
        ArmState(0, np.eye(4), np.zeros(6), ArmMode.MOVING, "", solution.path[middle])
        for solution in (first, second)
    )
    neighbour = Neighbour(scenes[0], scenes[1], lambda: other)

    def fresh() -> np.ndarray:
        return q + 1e-6 * random.random(len(q))

    nothing, rates = microseconds(fresh), joint_rates(arm, own.joints, twist)
    slow, stop = safety.singularity_slow, safety.singularity_stop
    T = arm.pose(q)
    calls = {
        "pose": lambda: arm.pose(fresh()),
        "Jacobian": lambda: arm.jacobian(fresh()),
        "follow a pose": lambda: arm.follow(fresh(), T),
        "joint speeds": lambda: joint_rates(arm, fresh(), twist),
        "joint limits and singularity": lambda: allowed_part(arm, fresh(), rates, 0.04, slow, stop),
    }
    found = {name: microseconds(call) - nothing for name, call in calls.items()}
    for name, much in (("far for this speed", 1.0), ("near for this speed", 20.0)):
        call = functools.partial(neighbour.allowed_part, own, much * twist, much * rates, 0.04)
        found[f"another arm, {name}"] = microseconds(call)
    return found


def against_pinocchio(arm: Chain) -> str:
    """Largest differences to Pinocchio over random angles, and its time for pose and Jacobian."""
    try:
        import pinocchio
    except ImportError:
        return "pin is not installed"
    model, parent = pinocchio.Model(), 0
    for name, step in zip(arm.names, arm.steps[:-1], strict=True):
        parent = model.addJoint(parent, pinocchio.JointModelRZ(), pinocchio.SE3(step), name)
    end = pinocchio.SE3(arm.steps[-1])
    frame = model.addFrame(pinocchio.Frame("tool", parent, 0, end, pinocchio.FrameType.OP_FRAME))
    data, random, pose, jacobian = model.createData(), np.random.default_rng(0), 0.0, 0.0
    for _ in range(1000):
        q = random.uniform(arm.lower, arm.upper)
        J = pinocchio.computeFrameJacobian(model, data, q, frame, pinocchio.LOCAL)
        pinocchio.framesForwardKinematics(model, data, q)
        pose = max(pose, float(np.abs(data.oMf[frame].homogeneous - arm.pose(q)).max()))
        jacobian = max(jacobian, float(np.abs(J - arm.jacobian(q)).max()))
    cost = microseconds(lambda: pinocchio.computeFrameJacobian(model, data, q, frame, pinocchio.LOCAL), 10000)
    return f"pose differs by {pose:.1e}, Jacobian by {jacobian:.1e}; its Jacobian takes {cost:.1f} us"


def pushes(name: str, layout: str, seeds: int) -> None:
    """Whole dual-arm pushes in closed loop, ideal sensors, with the arms' kinematics and without."""
    leader = pushed_path(0.010)
    ways = leader, facing(leader, 0.06)
    pair = [solve(name, base, poses) for base, poses in zip(LAYOUTS[layout], ways, strict=True)]
    if None in pair:
        return
    for item in ("red_square", "blue_square", "yellow_hexagon"):
        for seed in range(1, seeds + 1):
            plain = pushing_scene(load_scene("dual_pushing"), item, "mdf", seed)
            arms = {
                role: dataclasses.replace(
                    plain.arms[role], T_world_base=solution.T_world_base, kinematics=solution.arm
                )
                for role, solution in zip(("leader", "follower"), pair, strict=True)
            }
            results = []
            for scene in (plain, dataclasses.replace(plain, arms=arms)):
                start = time.process_time()
                records = run_arms_offline(scene, "dual_pushing", OfflineOptions(fidelity="ideal", seed=seed))
                seconds = time.process_time() - start
                record = records["leader"]
                error = numbers_of(records)["push"]["error_mm"]
                results.append((record, f"{error:6.2f} mm {record.result['succeeded']} in {seconds:.1f} s"))
                if not record.result["succeeded"]:
                    print(record.result["reason"])
            m = Margins.of(pair[0].arm, followed(pair[0].arm, results[1][0].pose.T_base_sensor))
            print(
                f"{name} {layout} {item:15} seed {seed}: without {results[0][1]}, with {results[1][1]}; "
                f"{m.range_deg:.1f} deg, {100 * m.speed_share:.1f} %, {m.singular:.4f} m/rad"
            )


def main() -> None:
    """Print margins, costs and the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--arms", nargs="+", default=["panda", "fr3", "ur5e"])
    parser.add_argument("--speed", type=float, default=0.010, help="m/s")
    parser.add_argument("--width", type=float, default=0.06, help="of the object, m")
    parser.add_argument("--push", type=int, default=0, metavar="SEEDS", help="whole pushes, this many a row")
    args = parser.parse_args()
    if args.push:
        for name in args.arms:
            for layout in LAYOUTS:
                pushes(name, layout, args.push)
        return
    leader = pushed_path(args.speed)
    follower = facing(leader, args.width)
    print("arm    bases    role      adapter  range's end  joint speed  singular value   above floor  apart")
    for name in args.arms:
        for layout, bases in LAYOUTS.items():
            pair = [solve(name, base, poses) for base, poses in zip(bases, (leader, follower), strict=True)]
            both = None not in pair
            for role, solution in zip(("leader", "follower"), pair, strict=True):
                if solution is None:
                    print(f"{name:7}{layout:9}{role:10}cannot")
                    continue
                m = solution.margins
                print(
                    f"{name:7}{layout:9}{role:10}{solution.turned_deg:4d} deg{m.range_deg:12.1f} deg"
                    f"{100 * m.speed_share:11.1f} %{m.singular:10.4f} m/rad{m.floor_mm:10.1f} mm"
                    + (
                        f"{1e3 * apart(*pair):7.1f} mm{100 * followed_part(*pair):6.0f} %"
                        if both and role == "leader"
                        else ""
                    )
                )
        if both:
            print(f"{name}: " + ", ".join(f"{k} {v:.0f} us" for k, v in costs(*pair).items()))
        print(f"{name} against Pinocchio: {against_pinocchio(with_adapter(load_arm(name), 0.0))}")


if __name__ == "__main__":
    main()
