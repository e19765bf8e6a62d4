"""Models of planar friction against real pushes of a triangular block: motions, loads, and whole pushes.

Data of Zhou, Mason, Paolini and Bagnell, "A convex polynomial force-motion model for planar sliding" (ICRA
2016): a right-angled block with legs of 150 mm is pushed by a metal finger. A file is a stream of numbers:
how many pushes, and of each the block's pose before and after (x y z mm, quaternion w x y z), how many rows
of force (time in s, two components in N), the rows, how many rows of the finger's pose (time, and as
above), the rows.

What the data's description leaves open was found by what must hold, in all files that were at hand: the
block's frame has its origin in the right-angled corner and the axes along the legs (so the finger ends
within 1 mm of an edge), the finger has no extent to speak of, and the forces are the sensor's, which is
turned by 45 degrees and mirrored against the finger (so each push does positive work). Forces are less what
the sensor says before contact.

A file is named after what the block stands on: `patch`, its whole foot, or `x1_x2_x3_y1_y2_y3`, points in
mm from the corner.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_sim.planar_friction import FrictionModel

Array = NDArray[np.float64]

LEG = 0.150  # m
CORNERS = np.array([[0.0, 0.0], [LEG, 0.0], [0.0, LEG]])
CENTER = CORNERS.mean(axis=0)  # of gravity, of a block of even thickness, and of friction
_FIELDS = 13  # of the foot's pressure, along a leg
_QUIET = 20  # first rows of force, without contact
_ANGLES = 9  # of the force within its cone of friction
_STEP = 0.5e-3  # m, of the finger
_TOUCHING = 0.5  # of the larger forces of a push, above which it touches
_TURN = math.sqrt(0.5) * np.array(
    [[-1.0, -1.0], [-1.0, 1.0]]
)  # from the sensor to the finger, onto the block


@dataclass(frozen=True)
class Push:
    """One push: planar poses (x, y, m; angle, rad) of the block and the finger, and forces.

    Attributes
    ----------
    before, after : (3,) pose of the block
    finger : (n, 4) time, and pose
    force : (k, 3) time, and N on the block, in the world
    """

    before: Array
    after: Array
    finger: Array
    force: Array


@dataclass(frozen=True)
class Slide:
    """What a push says of friction: mean load on the floor, N and N m about `CENTER`, and the whole motion.

    Both (3,), in the block's frame; the motion is (m, m, rad).
    """

    load: Array
    motion: Array


def read_pushes(path: Path) -> list[Push]:
    """The pushes of a file; `ValueError` says at which one it is not as it should be."""
    try:
        numbers = np.array(path.read_text().split(), dtype=np.float64)
    except ValueError as error:
        raise ValueError(f"{path}: must hold numbers alone: {error}") from error
    if not len(numbers) or not np.isfinite(numbers).all():
        raise ValueError(f"{path}: holds {'a number that is not finite' if len(numbers) else 'nothing'}")
    rest = _Numbers(path, numbers[1:])
    pushes = [rest.push(number) for number in range(1, int(numbers[0]) + 1)]
    if len(rest.left):
        raise ValueError(
            f"{path}: {len(rest.left)} numbers follow after {len(pushes)} pushes, as many as it names"
        )
    return pushes


class _Numbers:
    """Takes the numbers of a file one push after the other."""

    def __init__(self, path: Path, numbers: Array) -> None:
        self._path, self.left = path, numbers

    def push(self, number: int) -> Push:
        """The next one."""
        where = f"{self._path}: push {number}"
        poses = self._take(14, f"{where}: poses of the block")
        force = self._rows(3, f"{where}: force")
        finger = self._rows(8, f"{where}: finger")
        path = np.column_stack([finger[:, 0], np.array([_planar(row[1:], where) for row in finger])])
        turned = np.interp(force[:, 0], path[:, 0], np.unwrap(path[:, 3]))
        clean = (force[:, 1:] - np.median(force[:_QUIET, 1:], axis=0)) @ _TURN.T
        world = np.einsum("nij,nj->ni", _rotation(turned), clean)
        block = _planar(poses[:7], where), _planar(poses[7:], where)
        return Push(*block, path, np.column_stack([force[:, 0], world]))

    def _rows(self, width: int, what: str) -> Array:
        count = self._take(1, f"{what}: number of rows")[0]
        if count != int(count) or count <= _QUIET:
            raise ValueError(f"{what}: {count:g} rows, must be a whole number above {_QUIET}")
        return self._take(int(count) * width, what).reshape(-1, width)

    def _take(self, count: int, what: str) -> Array:
        if count > len(self.left):
            raise ValueError(f"{what}: the file ends {count - len(self.left)} numbers early")
        taken, self.left = self.left[:count], self.left[count:]
        return taken


def _planar(pose: Array, where: str) -> Array:
    """Position in m and angle about z of a pose (7,) in mm that lies flat."""
    w, x, y, z = pose[3:]
    if abs(math.hypot(w, x, y, z) - 1.0) > 0.05 or math.hypot(x, y) > 0.1:
        raise ValueError(f"{where}: {pose[3:]} is no quaternion (w x y z) of a rotation about z")
    return np.array([1e-3 * pose[0], 1e-3 * pose[1], 2.0 * math.atan2(z, w)])


def support_of(path: Path) -> Array:
    """Points (n, 2) that carry the block, m in its frame: fields of its foot, or those of the file's name."""
    if path.stem == "patch":
        middles = LEG * (np.arange(_FIELDS) + 0.5) / _FIELDS
        x, y = np.meshgrid(middles, middles)
        return np.stack([x, y], axis=-1)[x + y < LEG]
    try:
        numbers = [1e-3 * float(part) for part in path.stem.split("_")]
    except ValueError:
        numbers = []
    if len(numbers) < 6 or len(numbers) % 2:
        raise ValueError(
            f"{path}: is named after no support: must be patch, or x1_x2_x3_y1_y2_y3 (mm), the points' "
            "coordinates from the corner"
        )
    return np.array(numbers).reshape(2, -1).T


def shares_of(points: Array) -> Array:
    """Part of the weight (n,) on each point: those next to equal ones that have `CENTER` as their mean."""
    arms = np.vstack([(points - CENTER).T, np.ones(len(points))])
    even = np.full(len(points), 1.0 / len(points))
    wanted = np.array([0.0, 0.0, 1.0]) - arms @ even
    shares = even + np.linalg.lstsq(arms, wanted, rcond=None)[0]
    if shares.min() <= 0.0 or abs(arms @ shares - [0.0, 0.0, 1.0]).max() > 1e-9:
        raise ValueError(f"the block does not stand on the points {points.tolist()}: it would fall over")
    return shares


def slide_of(push: Push) -> Slide:
    """Load and motion of a push; the load is the mean of the last three quarters of its contact."""
    turn = _wrapped(push.after[2] - push.before[2])
    R_mid = _rotation(push.before[2] + 0.5 * turn)
    ends = [pose[:2] + _rotation(pose[2]) @ CENTER for pose in (push.before, push.after)]
    size = np.linalg.norm(push.force[:, 1:], axis=1)
    first = int(np.argmax(size > _TOUCHING * np.quantile(size, 0.9)))
    force = R_mid.T @ push.force[first + (len(size) - first) // 4 :, 1:].mean(axis=0)
    x, y = _in_block(push.finger[-1, 1:3], push.after) - CENTER
    load = np.array([*force, x * force[1] - y * force[0]])
    return Slide(load, np.array([*(R_mid.T @ (ends[1] - ends[0])), turn]))


def slope_of(push: Push, slide: Slide) -> float:
    """The finger's force along the edge over that across."""
    force = slide.load[:2]
    _, normal, _ = _nearest_edge(_in_block(push.finger[-1, 1:3], push.after))
    return abs(float(_left_of(normal) @ force)) / max(float(normal @ force), 1e-9)


def predicted_end(push: Push, model: FrictionModel, length: float, grip: float) -> Array:
    """Where a push leaves the block (3,), by its pose before, the finger's way and the friction alone.

    Quasi-static, step by step: the finger's force lies within its cone of friction, where the edge follows
    the finger if there is such a force, else at its side, along which it slides (Mason 1986).

    Parameters
    ----------
    length : of the model's loads, m
    grip : friction of the finger at the edge
    """
    pose = push.before.copy()
    points = push.finger[:, 1:3]
    way = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
    even = np.linspace(0.0, way[-1], max(2, math.ceil(way[-1] / _STEP)))
    path = np.column_stack([np.interp(even, way, points[:, axis]) for axis in range(2)])
    tilts = np.linspace(-1.0, 1.0, _ANGLES) * math.atan(grip)
    for before, after in itertools.pairwise(path):
        deep, normal, edge = _nearest_edge(_in_block(after, pose))
        if deep <= 0.0:
            continue
        arm = edge - CENTER
        force = np.stack([np.cos(tilts), np.sin(tilts)], axis=1) @ np.stack([normal, _left_of(normal)])
        torque = (arm[0] * force[:, 1] - arm[1] * force[:, 0]) / length
        motion = model.motion(np.column_stack([force, torque])) / [1.0, 1.0, length]
        move = _following(motion, arm, normal, _rotation(pose[2]).T @ (after - before), deep)
        pose = _moved(pose, move)
    return pose


def end_error(push: Push, found: Array) -> tuple[float, float]:
    """How far (m) and by which angle (rad) a pose (3,) is off the one in which the block was left."""
    middle, true = (pose[:2] + _rotation(pose[2]) @ CENTER for pose in (found, push.after))
    return float(np.linalg.norm(middle - true)), abs(_wrapped(found[2] - push.after[2]))


def _following(motion: Array, arm: Array, normal: Array, wanted: Array, deep: float) -> Array:
    """Of the motions (n, 3) that forces in the cone make, that which takes the edge along with the finger."""
    edge = motion[:, :2] + motion[:, 2:] * _left_of(arm)
    side = _left_of(normal)
    slope = (edge @ side) / np.maximum(edge @ normal, 1e-9)
    asked = float(wanted @ side) / max(float(wanted @ normal), 1e-9)
    order = np.argsort(slope)
    chosen = np.array([np.interp(asked, slope[order], motion[order, axis]) for axis in range(3)])
    gone = float((chosen[:2] + chosen[2] * _left_of(arm)) @ normal)
    return np.asarray(chosen * deep / max(gone, 1e-9))


def _moved(pose: Array, move: Array) -> Array:
    """A pose after a small motion (3,) about `CENTER`, in the block's frame."""
    middle = pose[:2] + _rotation(pose[2]) @ CENTER + _rotation(pose[2] + 0.5 * move[2]) @ move[:2]
    turned = pose[2] + move[2]
    return np.array([*(middle - _rotation(turned) @ CENTER), turned])


def _nearest_edge(point: Array) -> tuple[float, Array, Array]:
    """How far (m) a point (2,) is inside the nearest edge, that edge's inward normal, and the point on it."""
    ends = np.roll(CORNERS, -1, axis=0)
    along = (ends - CORNERS) / np.linalg.norm(ends - CORNERS, axis=1)[:, None]
    inward = np.stack([-along[:, 1], along[:, 0]], axis=1)
    deep = ((point - CORNERS) * inward).sum(axis=1)
    k = int(np.argmin(deep))
    return float(deep[k]), inward[k], point - deep[k] * inward[k]


def _in_block(point: Array, pose: Array) -> Array:
    return np.asarray(_rotation(pose[2]).T @ (point - pose[:2]))


def _rotation(angle: ArrayLike) -> Array:
    """Of angles (...), as (..., 2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def _left_of(vector: Array) -> Array:
    """A vector (2,) turned by 90 degrees."""
    return np.array([-vector[1], vector[0]])


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)
