"""Chain: the kinematics of an arm whose joints turn one after the other.

    chain = load_arm("fr3").with_tool(T_flange_tool)
    T = chain.pose(q)                   # of the tool in the base, at joint angles (n,), rad
    J = chain.jacobian(q)               # of the tool's twist [v, omega], in the tool's frame
    q = chain.reach(T, chain.ready)     # joint angles for a pose
    q = chain.follow(q, T_next)         # and for the poses after it

Joint i turns about the z axis of its own frame, which stands in the frame of the joint before it, turned, at
`steps[i - 1]`; the last step leads to the tool.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_geometry import se3
from tactile_scene.kinematics.capsules import Capsules
from tactile_scene.kinematics.joint_limits import LENGTH
from tactile_scene.kinematics.urdf import Description

Array = NDArray[np.float64]

_SCALE = np.repeat([1.0, LENGTH], 3)  # makes rotations comparable with ways
_DAMPING = 1e-3  # m/rad; far below the singular values at which an arm is stopped
_TO_MIDDLE = 0.5  # the joints move towards their middle by at most this part of what they move anyway
_LARGEST_STEP = 0.3  # rad, of a joint in one step of `reach`
_STEPS, _TRIES = 150, 24  # of `reach`
_REACHED = 1e-7  # m
_NEAR, _TURNED = 1e-3, 1e-2  # m and rad that joints may be off the pose that they follow


@dataclass(eq=False)
class Chain:
    """See the module's text; what it is asked for is in the base's frame. Nobody writes to its arrays.

    Attributes
    ----------
    path : Path
        Of the arm's file.
    names : tuple of str
        Of the n joints.
    steps : ndarray (n + 1, 4, 4)
    lower, upper, velocity, acceleration : ndarray (n,)
        Range (rad), largest speed (rad/s) and acceleration (rad/s^2) of each joint.
    ready : ndarray (n,)
        Angles in a good posture, rad, from which others are looked for.
    links : Capsules
        Each in the frame of its joint, turned, or of the base.
    description : Description or None
        Of an arm that a URDF describes.
    """

    path: Path
    names: tuple[str, ...]
    steps: Array
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    ready: Array
    links: Capsules
    description: Description | None = field(default=None, repr=False)
    _last: tuple[Array, Array, Array] | None = field(default=None, init=False, repr=False)

    @property
    def middle(self) -> Array:
        """The middle of each joint's range (n,), rad."""
        return 0.5 * (self.lower + self.upper)

    @functools.cached_property
    def spans(self) -> Array:
        """How far (n,) from each joint's axis the links after it reach at most, m."""
        found, after = np.zeros(len(self.names)), 0.0
        for joint in range(len(found), 0, -1):
            ends = np.linalg.norm(self.links.ends[self.links.joints == joint], axis=-1)
            after = found[joint - 1] = max(float(ends.max(initial=0.0)), after)
            after += float(np.linalg.norm(self.steps[joint - 1, :3, 3]))
        return found

    def with_tool(self, T_flange_tool: Array, *tool: tuple[ArrayLike, ArrayLike, float]) -> Chain:
        """The chain to a tool; its capsules, (from, to, radius), are in the flange's frame."""
        steps = self.steps.copy()
        ends = np.array([(start, end) for start, end, _ in tool], dtype=np.float64).reshape(-1, 2, 3)
        ends = ends @ steps[-1, :3, :3].T + steps[-1, :3, 3]
        steps[-1] = steps[-1] @ T_flange_tool
        links = Capsules(
            np.concatenate([self.links.ends, ends]),
            np.concatenate([self.links.radii, [radius for _, _, radius in tool]]),
            np.concatenate([self.links.joints, np.full(len(tool), len(self.names))]),
        )
        return replace(self, steps=steps, links=links)

    def frames(self, q: Array) -> Array:
        """Frames (n + 2, 4, 4) of the base, of each joint, turned, and of the tool, at joint angles (n,)."""
        return self._posture(q)[1]

    def pose(self, q: Array) -> Array:
        """Pose (4, 4) of the tool at joint angles (n,)."""
        return np.asarray(self.frames(q)[-1])

    def jacobian(self, q: Array) -> Array:
        """Jacobian (6, n) of the tool's twist [v, omega], in the tool's frame, at joint angles (n,)."""
        return self._posture(q)[2]

    def capsules(self, q: Array) -> Capsules:
        """The links at joint angles (n,)."""
        return _placed(self.links, self.frames(q))

    def follow(self, q: Array, T: Array) -> Array:
        """Joint angles (n,) that lead the tool on to a pose (4, 4) near to the one that it has at `q`.

        One step of damped least squares; an arm of more than six joints also moves towards the middle of
        their ranges, by a part of what it moves anyway.
        """
        step, free, _ = self._step(q, T)
        length = float(np.linalg.norm(free))
        moved = float(np.linalg.norm(step))
        return q + step + free * (min(1.0, _TO_MIDDLE * moved / length) if length > 0.0 else 0.0)

    def follows(self, q: Array, T: Array) -> bool:
        """Whether the tool is at a pose (4, 4), as near as `follow` must keep it."""
        error = se3.log(se3.inverse(self.pose(q)) @ T)
        return bool(np.linalg.norm(error[:3]) < _NEAR and np.linalg.norm(error[3:]) < _TURNED)

    def out_of_range(self, q: Array) -> str:
        """Which joint is beyond its range, and how far; '' for none."""
        beyond = np.maximum(q - self.upper, self.lower - q)
        joint = int(beyond.argmax())
        if beyond[joint] <= 1e-6:
            return ""
        low, high, angle = np.degrees([self.lower[joint], self.upper[joint], q[joint]])
        return f"{self.names[joint]} is at {angle:.1f} degrees, its range is {low:.1f} to {high:.1f}"

    def reach(self, T: Array, q: Array) -> Array:
        """Joint angles (n,) within their ranges at which the tool has a pose (4, 4).

        They are looked for from `q`, then from elsewhere, always the same for the same arguments; an arm of
        more than six joints has them as near to the middle of their ranges as they come from there.

        Raises ValueError, with how near the arm comes, if none were found.
        """
        random = np.random.default_rng(0)
        best, nearest = np.inf, q
        for attempt in range(_TRIES):
            guess = q if attempt == 0 else random.uniform(self.lower, self.upper)
            found, error = self._search(guess, T)
            if error < _REACHED:
                return found
            if error < best:
                best, nearest = error, found
        error6 = se3.log(se3.inverse(self.pose(nearest)) @ T)
        way, turn = np.linalg.norm(error6[:3]) * 1e3, np.degrees(np.linalg.norm(error6[3:]))
        raise ValueError(
            f"out of reach of the {self.path.stem}: it comes within {way:.0f} mm, {turn:.0f} degrees"
        )

    def _posture(self, q: Array) -> tuple[Array, Array, Array]:
        """Angles, frames and Jacobian; the last are kept, since within a step several ask for the same."""
        last = self._last
        if last is not None and np.array_equal(last[0], q):
            return last
        turns = np.zeros((len(q), 4, 4))
        turns[:, 2, 2] = turns[:, 3, 3] = 1.0
        turns[:, 0, 0] = turns[:, 1, 1] = np.cos(q)
        turns[:, 1, 0] = np.sin(q)
        turns[:, 0, 1] = -turns[:, 1, 0]
        frames = np.empty((len(turns) + 2, 4, 4))
        frames[0] = np.eye(4)
        frames[1:-1] = self.steps[:-1] @ turns
        for i in range(2, len(turns) + 1):
            frames[i] = frames[i - 1] @ frames[i]
        frames[-1] = frames[-2] @ self.steps[-1]
        jacobian = _jacobian(frames)
        frames.flags.writeable = jacobian.flags.writeable = False
        self._last = q.copy(), frames, jacobian
        return self._last

    def _search(self, q: Array, T: Array) -> tuple[Array, float]:
        """Steps from a guess to a pose, within the ranges; the angles, and how far (m) the tool is off."""
        error = np.inf
        for _ in range(_STEPS):
            step, free, error = self._step(q, T)
            step += free
            largest = np.abs(step).max()
            if error < _REACHED and largest < 1e-4:
                break
            step *= min(1.0, _LARGEST_STEP / max(largest, _LARGEST_STEP))
            q = np.clip(q + step, self.lower, self.upper)
        return q, error

    def _step(self, q: Array, T: Array) -> tuple[Array, Array, float]:
        """A step of the joints (n,) towards a pose (4, 4), and one halfway to their middle that the tool does
        not feel, zero with six joints; and how far (m) the tool is off the pose.
        """
        _, frames, jacobian = self._posture(q)
        error = _SCALE * se3.log(se3.inverse(frames[-1]) @ T)
        U, values, Vt = np.linalg.svd(_SCALE[:, None] * jacobian)
        count = len(values)
        step = Vt[:count].T @ (values / (values**2 + _DAMPING**2) * (U[:, :count].T @ error))
        unfelt = Vt[count:]
        return step, 0.5 * unfelt.T @ (unfelt @ (self.middle - q)), float(np.linalg.norm(error))


def point_velocities(frames: Array, joints: NDArray[np.intp], points: Array, rates: Array) -> Array:
    """Velocities (..., 3) of points (..., 3) of the base's frame that move with joints (...), m/s.

    `frames` are a chain's, `rates` (n,) its joints' speeds, rad/s; joint 0 is the base.
    """
    axes, origins = frames[1:-1, :3, 2], frames[1:-1, :3, 3]
    turning = axes * rates[:, None]
    # sum of turning x (point - origin) over the joints up to each one's
    omega = np.concatenate([np.zeros((1, 3)), np.cumsum(turning, axis=0)])[joints]
    moment = np.concatenate([np.zeros((1, 3)), np.cumsum(_cross(turning, origins), axis=0)])[joints]
    return _cross(omega, points) - moment


def _jacobian(frames: Array) -> Array:
    R, p = frames[-1, :3, :3], frames[-1, :3, 3]
    axes = frames[1:-1, :3, 2]
    columns = np.concatenate([_cross(axes, p - frames[1:-1, :3, 3]) @ R, axes @ R], axis=1)
    return np.asarray(columns.T)


def _placed(links: Capsules, frames: Array) -> Capsules:
    at = frames[links.joints]
    ends = links.ends @ at[:, :3, :3].transpose(0, 2, 1) + at[:, None, :3, 3]
    return Capsules(ends, links.radii, links.joints)


def _cross(a: Array, b: Array) -> Array:
    """As np.cross, which takes five times as long for so few."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    z = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack([x, y, z], axis=-1)
