"""Pushed objects and the tips that push them, in the plane, N trials at once: see pushing_plane.py."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_scene.shapes import SHAPES
from tactile_scene.simulated_sensors import IdealSensorSettings
from tactile_sim.limit_surface import Foot
from tactile_sim.network_error import NetworkError, load_error_model
from tactile_sim.pushing_scene import GAP, PushVariation, draw, read_profiles
from tactile_sim.skin_force import SkinForces

Array = NDArray[Any]

TIP, HEIGHT, GRAVITY = 0.020, 0.045, 9.81
PRESSED = (
    0.42  # part of its depth that a tip, which rolls on its radius less that, is pressed in (ideal_sensor)
)
START, TARGET = np.array([0.1, -0.25]), np.array([0.375, 0.0])
SENSOR = IdealSensorSettings()
NOISE = np.array([SENSOR.sigma_rotation[0], SENSOR.sigma_position[1], SENSOR.sigma_position[2]])
AVERAGED = 0.25  # weight of an image in the noise of a belief
DT = 1.0 / 60.0


def across(v: Array) -> Array:
    """The vectors (N, 2) turned to the left by 90 degrees: y of a frame whose z they are, x being down."""
    return np.stack([-v[:, 1], v[:, 0]], axis=1)


def direction(angle: Array) -> Array:
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def wrapped(angle: Array) -> Array:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@dataclass(frozen=True)
class Physics:
    """What is assumed of tips and objects.

    Attributes
    ----------
    skin : forces of the tips
    noise : of the sensors, over the ideal sensor's
    network : the sensors err as the network does, in place of noise
    """

    skin: SkinForces = field(default_factory=lambda: SkinForces(skin_force=8.45, skin_shear=1053.0))
    noise: float = 1.0
    network: bool = False


class Plant:
    """N objects on their floors, each with the tips of one or two arms before it."""

    def __init__(
        self,
        trials: Sequence[tuple[str, str, int]],
        arms: int,
        variation: PushVariation,
        physics: Physics | None = None,
    ) -> None:
        self.physics = physics or Physics()
        known, self.count = read_profiles(), len(trials)
        drawn = np.array([draw(*trial) for trial in trials])
        self.friction = np.array([known.floors[floor] for _, floor, _ in trials])
        self.friction = self.friction * (1.0 + variation.friction * drawn[:, 0])
        self.off_center = variation.center_of_friction * drawn[:, 1:3]
        self.weight = GRAVITY * np.array([known.objects[name].number("mass") for name, _, _ in trials])
        outlines = [_outline(known.objects[name]) for name, _, _ in trials]
        self.radius = np.array([outline.radius for outline in outlines])
        self.normals = np.array([outline.normals for outline in outlines])
        self.distances = np.array([outline.distances for outline in outlines])
        self.arm = np.array([outline.arm for outline in outlines])
        half = np.array([outline.half for outline in outlines])
        self.center = np.stack(
            [START[0] - variation.placement * drawn[:, 3], START[1] + TIP + GAP + half], axis=1
        )
        self.turn = np.radians(variation.angle_deg) * drawn[:, 4]
        self.tips = [np.tile(START, (self.count, 1))]
        self.headings = [np.full(self.count, 0.5 * np.pi)]
        if arms == 2:
            self.tips.append(self.tips[0] + np.stack([0.0 * half, 2.0 * (TIP + GAP + half)], axis=1))
            self.headings.append(np.full(self.count, -0.5 * np.pi))
        self.shears = [np.zeros(self.count) for _ in range(arms)]
        self.force = np.zeros((self.count, 2))
        self._random = np.random.default_rng(0)
        self._noise = [np.zeros((self.count, 3)) for _ in range(arms)]
        self._slips = [np.zeros(self.count, bool) for _ in range(arms)]
        self._errors = [_NetworkErrors(self.count, arm) for arm in range(arms)]

    def contact(self, arm: int) -> tuple[Array, Array]:
        """Contact normals into the objects (N, 2), and depths (N,), m."""
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        R = np.stack([np.stack([cos, -sin], 1), np.stack([sin, cos], 1)], 1)
        p = np.einsum("nji,nj->ni", R, self.tips[arm] - self.center)
        beyond = np.einsum("nmi,ni->nm", self.normals, p) - self.distances
        nearest, rows, length = beyond.argmax(axis=1), np.arange(self.count), np.linalg.norm(p, axis=1)
        round_ = self.radius > 0.0
        outward = np.where(round_[:, None], p / length[:, None], self.normals[rows, nearest])
        distance = np.where(round_, length - self.radius, beyond[rows, nearest])
        return -np.einsum("nij,nj->ni", R, outward), TIP - distance

    def believed(self, arm: int) -> tuple[Array, Array, Array]:
        """Angle of the contact normal (N,), shear (N,) and depth (N,) of the last step, with noise."""
        normal, depth = self.contact(arm)
        angle = np.arctan2(normal[:, 1], normal[:, 0])
        if self.physics.network:
            tilt = wrapped(angle - self.headings[arm])
            fresh = self._errors[arm](tilt, self.shears[arm], depth, self._slips[arm])
        else:
            fresh = self.physics.noise * NOISE * self._random.standard_normal((self.count, 3))
        self._noise[arm] += AVERAGED * (fresh - self._noise[arm])
        errors = self._noise[arm].T
        return angle + errors[0], self.shears[arm] + errors[1], depth + errors[2]

    def step(self, velocities: Sequence[Array], turnings: Sequence[Array]) -> None:
        """Move the tips by their velocities (N, 2) in the world and turnings (N,), and what they push."""
        skin = self.physics.skin
        pivot = self.center + np.einsum("nij,nj->ni", _rotation(self.turn), self.off_center)
        pivot = pivot + HEIGHT * self.force / self.weight[:, None]  # the pressure runs ahead
        load, stiffness, touches = np.zeros((self.count, 3)), np.zeros((self.count, 3, 3)), []
        for arm, (velocity, turning) in enumerate(zip(velocities, turnings, strict=True)):
            self.tips[arm] = self.tips[arm] + velocity * DT
            self.headings[arm] = self.headings[arm] + turning * DT
            normal, depth = self.contact(arm)
            side, deep = across(normal), np.maximum(depth, 1e-6)
            arm_rolled = TIP - PRESSED * deep
            rolled = (velocity * side).sum(axis=1) + turning * arm_rolled
            shear = np.where(depth > 0.0, self.shears[arm] + rolled * DT, 0.0)
            press, along, sideways = _skin(skin, deep, depth > 0.0)
            largest = np.interp(deep, SENSOR.shear_depths, SENSOR.shear_limits)
            largest = np.minimum(largest, skin.friction_tip * press / np.maximum(sideways, 1e-9))
            self._slips[arm] = np.abs(shear) > largest
            shear = np.clip(shear, -largest, largest)
            jacobian = np.zeros((self.count, 2, 3))
            reach = self.tips[arm] + (TIP - deep)[:, None] * normal - pivot
            jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
            jacobian[:, 0, 2], jacobian[:, 1, 2] = -reach[:, 1], reach[:, 0]
            springs = _outer(along, normal) + _outer(sideways, side)
            force = press[:, None] * normal + (sideways * shear)[:, None] * side
            load += np.einsum("nij,ni->nj", jacobian, force)
            stiffness += np.einsum("nia,nij,njb->nab", jacobian, springs, jacobian)
            matter = jacobian.copy()  # how the body moves under the part of the tip that rolls on it
            under = self.tips[arm] + arm_rolled[:, None] * normal - pivot
            matter[:, 0, 2], matter[:, 1, 2] = -under[:, 1], under[:, 0]
            touches.append((arm, side, shear, matter))
        motion = self._given_way(load, stiffness)  # dx, dy and turn about the pivot
        self.center = self.center + motion[:, :2] + motion[:, 2:] * across(self.center - pivot)
        self.turn = self.turn + motion[:, 2]
        self.force = np.zeros((self.count, 2))
        for arm, side, shear, matter in touches:
            moved = np.einsum("nij,nj->ni", matter, motion)
            self.shears[arm] = shear - (moved * side).sum(axis=1)
            normal, depth = self.contact(arm)
            press, _, sideways = _skin(skin, np.maximum(depth, 1e-6), depth > 0.0)
            self.force += press[:, None] * normal + (sideways * self.shears[arm])[:, None] * across(normal)

    def _given_way(self, load: Array, stiffness: Array) -> Array:
        """Motions (N, 3) until friction carries the loads: `limit_surface.return_to_surface` in arrays."""
        most = self.friction * self.weight
        scale = np.stack([1.0 / most, 1.0 / most, 1.0 / (most * self.arm)], axis=1)
        used = scale * load
        moves = (used**2).sum(axis=1) > 1.0
        softness, axes = np.linalg.eigh(scale[:, :, None] * stiffness * scale[:, None, :])
        softness, part = np.maximum(softness, 0.0), np.einsum("nij,ni->nj", axes, used)
        x = np.zeros(self.count)
        for _ in range(12):
            grown = 1.0 + x[:, None] * softness
            squares = (part / grown) ** 2
            total, slope = squares.sum(axis=1), 2.0 * (squares * softness / grown).sum(axis=1)
            x = np.where(moves, x + 2.0 * total * (np.sqrt(total) - 1.0) / np.maximum(slope, 1e-30), 0.0)
        left = np.einsum("nij,nj->ni", axes, part / (1.0 + x[:, None] * softness))
        return np.where(moves[:, None], x[:, None] * scale * left, 0.0)


class _NetworkErrors:
    """How the network errs on N contacts, of which the plane knows and takes three numbers."""

    def __init__(self, count: int, seed: int) -> None:
        self.model = load_error_model()
        self._errors = NetworkError(self.model, seed, (count,))
        self._present = np.zeros(count, bool)

    def __call__(self, tilt: Array, shear: Array, depth: Array, slips: Array) -> Array:
        """Errors (N, 3) of the normal's angle, the shear and the depth; none where it sees no contact."""
        present = depth >= np.where(self._present, self.model.leave, self.model.touch)
        self._errors.begin(present & ~self._present)
        self._present, pose = present, np.zeros((len(tilt), 6))
        pose[:, 1], pose[:, 2], pose[:, 3] = shear, depth, tilt
        error, _ = self._errors.errors(pose, slips)
        y, z, phi = error[:, 1], error[:, 2], error[:, 3]
        # X_sf is said in the sensor's frame, shear and depth are in the contact's, and x points down
        cos, sin = np.cos(tilt), np.sin(tilt)
        seen = np.stack([-phi, sin * z - cos * y, -(sin * y + cos * z)], axis=1)
        return np.where(present[:, None], seen, 0.0)


@dataclass(frozen=True)
class _Outline:
    """An object from above: a radius, or sides with outward normals (6, 2) and distances (6,)."""

    radius: float
    normals: Array
    distances: Array
    half: float
    arm: float


def _outline(profile: Any) -> _Outline:
    shape, values = profile.text("shape"), profile.section("parameters").values
    normals, distances, radius = np.zeros((6, 2)), np.full(6, 1e3), 0.0
    if shape == "cylinder":
        radius = float(values["radius"])
    else:
        sides = 4 if shape == "box" else int(values["sides"])
        angles = 2.0 * np.pi * np.arange(sides) / sides - 0.5 * np.pi
        normals[:sides] = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        x, y = values["size"][:2] if shape == "box" else (values["width"], values["width"])
        distances[:sides] = 0.5 * (np.abs(normals[:sides]) @ [x, y] if shape == "box" else x)
    body = SHAPES.load(shape)(profile.settings("parameters", SHAPES.load(shape).settings_class))
    points = body.grid().reshape(-1, 3)
    foot = Foot.around(points[points[:, 2] < points[:, 2].min() + 5e-4, :2])
    half = radius or float(distances[0])
    return _Outline(radius, normals, distances, half, foot.arm)


def _rotation(angle: Array) -> Array:
    cos, sin = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([cos, -sin], 1), np.stack([sin, cos], 1)], 1)


def _skin(skin: SkinForces, depth: Array, touches: Array) -> tuple[Array, Array, Array]:
    """Normal force, and stiffness along and across the normal."""
    press = np.where(touches, skin.skin_force * (depth / 6e-3) ** skin.skin_exponent, 0.0)
    sideways = np.where(touches, skin.skin_shear * (depth / 6e-3) ** skin.skin_shear_exponent, 0.0)
    return press, skin.skin_exponent * press / depth, sideways


def _outer(stiffness: Array, v: Array) -> Array:
    return stiffness[:, None, None] * v[:, :, None] * v[:, None, :]
