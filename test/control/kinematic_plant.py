"""A small plant to close the loop on: exact geometry of a sphere or a plane, a first-order arm, a delay.

No images and no skin: the belief is the exact surface contact pose without shear, of `delay` seconds ago.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from tactile_control.phases import StampedPose, StampedPresence, TaskInputs
from tactile_geometry import se3

MS = 1_000_000
PERIOD = 1.0 / 60.0
TIP_RADIUS = 0.020


def pointing_down(position=(0.0, 0.0, 0.0)) -> np.ndarray:
    """T_base_sensor with the sensor's z down and its y along the base's y."""
    T = np.diag([-1.0, 1.0, -1.0, 1.0])
    T[:3, 3] = position
    return T


class Sphere:
    """A ball of the given radius about the origin of the base."""

    def __init__(self, radius: float) -> None:
        self.radius = radius

    def query(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        distance = float(np.linalg.norm(p))
        return distance - self.radius, p / distance

    def top(self) -> np.ndarray:
        return np.array([0.0, 0.0, self.radius])


class Plane:
    """z = 0, outside above."""

    def query(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        return float(p[2]), np.array([0.0, 0.0, 1.0])

    def top(self) -> np.ndarray:
        return np.zeros(3)


def contact_pose(surface, T_base_sensor: np.ndarray) -> np.ndarray:
    """X_fs without shear: depth along z, the smallest rotation from the sensor's z to the inward normal."""
    distance, normal = surface.query(T_base_sensor[:3, 3])
    inward = T_base_sensor[:3, :3].T @ -normal  # f's z in s
    axis = np.cross(inward, [0.0, 0.0, 1.0])
    sine, angle = np.linalg.norm(axis), np.arctan2(np.linalg.norm(axis), inward[2])
    T = np.eye(4)
    if sine > 0.0:
        T = se3.exp(np.concatenate([np.zeros(3), axis / sine * angle]))
    T[2, 3] = TIP_RADIUS - distance
    return T


class Plant:
    """Kinematic arm over a surface: `step` moves it for one period, `inputs` is what the controller sees."""

    def __init__(
        self, surface, T_base_sensor, delay_steps=1, time_constant=0.02, period=PERIOD, seed=0
    ) -> None:
        self.surface = surface
        self.T = np.array(T_base_sensor, dtype=float)
        self.delay_steps = delay_steps
        self.time_constant = time_constant
        self.period_ns = round(period * 1e9)
        self.now_ns = 10**9
        self.twist = np.zeros(6)
        self.rng = np.random.default_rng(seed)
        self.noise = np.zeros(6)
        self.history = [(self.now_ns, self.T.copy())]

    def truth(self) -> np.ndarray:
        return contact_pose(self.surface, self.T)

    @property
    def depth(self) -> float:
        return float(self.truth()[2, 3])

    @property
    def tilt(self) -> float:
        return float(np.arccos(np.clip(self.truth()[2, 2], -1.0, 1.0)))

    def inputs(self) -> TaskInputs:
        stamp, T = self.history[max(0, len(self.history) - 1 - self.delay_steps)]
        X_fs = contact_pose(self.surface, T)
        noisy = se3.exp(self.noise * self.rng.standard_normal(6)) @ se3.inverse(X_fs)
        touching = bool(X_fs[2, 3] > 0.0003)
        return TaskInputs(
            belief=StampedPose(stamp, noisy) if touching else None,
            presence=StampedPresence(stamp, touching),
            sensor_pose=StampedPose(self.history[-1][0], self.history[-1][1]),
        )

    def step(self, twist: np.ndarray) -> None:
        dt = self.period_ns * 1e-9
        pieces = 4
        for _ in range(pieces):
            self.twist += (np.asarray(twist) - self.twist) * (1.0 - np.exp(-dt / pieces / self.time_constant))
            self.T = self.T @ se3.exp(self.twist * dt / pieces)
        self.now_ns += self.period_ns
        self.history.append((self.now_ns, self.T.copy()))


def run(task, plant, limit_s=60.0, change=None, each=None):
    """All commands of a run; `change(k, inputs)` may replace inputs, `each(k, command)` looks on."""
    commands = []
    for k in range(round(limit_s * 1e9 / plant.period_ns)):
        inputs = plant.inputs()
        if change is not None:
            inputs = change(k, inputs)
        command = task.step(plant.now_ns, inputs)
        commands.append((plant.now_ns, command, plant.depth, plant.tilt))
        if each is not None:
            each(k, command)
        if command.done:
            break
        plant.step(command.twist)
    return commands


def freeze_after(names, at_ns):
    """Inputs named stop arriving at `at_ns`."""
    kept = {}

    def change(k, inputs):
        latest = max((i.stamp_ns for i in (inputs.presence, inputs.sensor_pose) if i), default=0)
        for name in names:
            if latest < at_ns:
                kept[name] = getattr(inputs, name)
        return dataclasses.replace(inputs, **{n: kept[n] for n in names if latest >= at_ns})

    return change


def rest_after(commands, event_ns):
    """Milliseconds from an event to the first command of zero twist after which all are zero."""
    moving = [now for now, c, _, _ in commands if np.abs(c.twist).max() > 1e-6]
    return (max(moving, default=event_ns) - event_ns) / MS


class PushedFace:
    """The flat side of an object that gives way to a tip deeper than `depth`, and turns as it is pushed.

    The model of the paper's appendix: sideways motion of the contact by dy along the y-axis of its frame (x
    down, z into the object) turns the object by turning * dy about x; `drift` turns it with the way ahead, as
    a centre of friction beside the contact does.
    """

    def __init__(self, contact, normal, turning, depth=0.002, drift=0.0) -> None:
        self.contact, self.normal = np.array(contact, float), np.array(normal, float)
        self.turning, self.drift, self.depth = turning, drift, depth

    def query(self, p: np.ndarray) -> tuple[float, np.ndarray]:
        return float(self.normal @ (self.contact - p)), -self.normal

    def follow(self, before: np.ndarray, after: np.ndarray) -> None:
        """The sensor's centre has moved from `before` to `after`."""
        deeper = TIP_RADIUS - self.depth - self.query(after)[0]
        if deeper <= 0.0:
            return
        down = np.array([0.0, 0.0, -1.0])
        sideways = (after - before) @ np.cross(self.normal, down)
        self.contact = after + (TIP_RADIUS - self.depth) * self.normal
        turn = (self.turning * sideways + self.drift * deeper) * down
        self.normal = se3.exp(np.concatenate([np.zeros(3), turn]))[:3, :3] @ self.normal


class PushingPlant(Plant):
    """An arm that pushes a `PushedFace`; beliefs without delay."""

    def __init__(self, surface: PushedFace, T_base_sensor, **kwargs) -> None:
        super().__init__(surface, T_base_sensor, delay_steps=0, **kwargs)

    def step(self, twist: np.ndarray) -> None:
        before = self.T[:3, 3].copy()
        super().step(twist)
        self.surface.follow(before, self.T[:3, 3])
