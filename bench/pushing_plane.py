"""Pushing in the plane, many trials at once in arrays: fast enough for hundreds of trials of many options.

The physics are those of `tactile_sim/pushed.py` and of the ideal sensor, reduced to the plane of the
floor (one shear, no roll and pitch), and the controllers those of `tactile_control`, again in arrays; gains,
objects and floors come from the same files, the draws of a trial from the same seed. `pushing_options.py
--check` says how far its errors are from those of the loop without ROS. Left out: the arm's lag, the safe
stage, and the filter, in whose place the errors of a sensor are averaged over four images. Those errors are
the ideal sensor's noise, or what is fitted to the shipped network (`tactile_sim.network_error`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingGroups
from tactile_control.pose_steering import curvature
from tactile_control.steering import LEAST, SteeringSettings
from tactile_scene.shapes import SHAPES
from tactile_scene.simulated_sensors import IdealSensorSettings
from tactile_sim.limit_surface import Foot
from tactile_sim.network_error import NetworkError, load_error_model
from tactile_sim.pushing_scene import GAP, PushVariation, draw, read_profiles
from tactile_sim.skin_force import SkinForces

Array = NDArray[Any]

TIP, HEIGHT, GRAVITY = 0.020, 0.045, 9.81
START, TARGET = np.array([0.1, -0.25]), np.array([0.375, 0.0])
SENSOR = IdealSensorSettings()
NOISE = np.array([SENSOR.sigma_rotation[0], SENSOR.sigma_position[1], SENSOR.sigma_position[2]])
AVERAGED = 0.25  # weight of an image in the noise of a belief
DT = 1.0 / 60.0
APPROACH, SETTLING, HELD = 0.004, 1.0, 4.0  # m/s; s of settling, and until the follower holds the object
LONGEST = 120.0  # s


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
    height : of the tips over the floor, by which the pressure runs ahead of the middle, m
    pressed : part of its depth that a tip, which rolls on its radius less that, is pressed in
    size : of the objects along the floor, over the profiles'
    noise : of the sensors, over the ideal sensor's
    network : the sensors err as the network does, in place of noise
    latency : images between an exposure and the twist that answers it
    """

    skin: SkinForces = field(default_factory=lambda: SkinForces(skin_force=8.45, skin_shear=1053.0))
    height: float = HEIGHT
    pressed: float = 0.42  # tactile_sim.ideal_sensor
    size: float = 1.0
    noise: float = 1.0
    network: bool = False
    latency: int = 0


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
        known, self.trials, self.count = read_profiles(), tuple(trials), len(trials)
        drawn = np.array([draw(*trial) for trial in trials])
        self.friction = np.array([known.floors[floor] for _, floor, _ in trials])
        self.friction = self.friction * (1.0 + variation.friction * drawn[:, 0])
        self.off_center = variation.center_of_friction * drawn[:, 1:3]
        self.weight = GRAVITY * np.array([known.objects[name].number("mass") for name, _, _ in trials])
        size = self.physics.size
        outlines = [_outline(known.objects[name], size) for name, _, _ in trials]
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
        self.motion = np.zeros((self.count, 3))  # of the last step: dx, dy and turn about `pivot`
        self.pivot = self.center.copy()
        self._random = np.random.default_rng(0)
        self._noise = [np.zeros((self.count, 3)) for _ in range(arms)]
        self._slips = [np.zeros(self.count, bool) for _ in range(arms)]
        self._errors = [_NetworkErrors(self.count, arm) for arm in range(arms)]
        self._seen = [[] for _ in range(arms)]

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
        now = angle + errors[0], self.shears[arm] + errors[1], depth + errors[2]
        seen = self._seen[arm]
        seen.append(now)
        return seen.pop(0) if len(seen) > self.physics.latency else seen[0]

    def step(self, velocities: Sequence[Array], turnings: Sequence[Array]) -> None:
        """Move the tips by their velocities (N, 2) in the world and turnings (N,), and what they push."""
        skin = self.physics.skin
        pivot = self.center + np.einsum("nij,nj->ni", _rotation(self.turn), self.off_center)
        pivot = pivot + self.physics.height * self.force / self.weight[:, None]  # the pressure runs ahead
        load, stiffness, touches = np.zeros((self.count, 3)), np.zeros((self.count, 3, 3)), []
        for arm, (velocity, turning) in enumerate(zip(velocities, turnings, strict=True)):
            self.tips[arm] = self.tips[arm] + velocity * DT
            self.headings[arm] = self.headings[arm] + turning * DT
            normal, depth = self.contact(arm)
            side, deep = across(normal), np.maximum(depth, 1e-6)
            arm_rolled = TIP - self.physics.pressed * deep
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
        self.motion, self.pivot = self._given_way(load, stiffness), pivot
        self.center = self.center + self.motion[:, :2] + self.motion[:, 2:] * across(self.center - pivot)
        self.turn = self.turn + self.motion[:, 2]
        self.force = np.zeros((self.count, 2))
        for arm, side, shear, matter in touches:
            moved = np.einsum("nij,nj->ni", matter, self.motion)
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


def _outline(profile: Any, size: float) -> _Outline:
    shape, values = profile.text("shape"), profile.section("parameters").values
    normals, distances, radius = np.zeros((6, 2)), np.full(6, 1e3), 0.0
    if shape == "cylinder":
        radius = float(values["radius"])
        distances[:] = 1e3
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
    return _Outline(size * radius, normals, size * distances, size * half, size * foot.arm)


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


class Pid:
    """`tactile_control.pid.TangentPid`, one channel of N trials."""

    def __init__(
        self,
        count: int,
        gains: Sequence[float],
        limit: float,
        output: float = np.inf,
        anti_windup: bool = True,
    ) -> None:
        self.gains, self.limit, self.output, self.anti_windup = gains, limit, output, anti_windup
        self.integral = np.zeros(count)
        self.smooth: Array | None = None

    def __call__(self, error: Array) -> Array:
        kp, ki, kd = self.gains
        before = error if self.smooth is None else self.smooth
        started, self.smooth = self.smooth is not None, 0.5 * before + 0.5 * error
        law = kp * error + kd * (self.smooth - before) / DT
        if started:
            grown = np.clip(self.integral + error * DT, -self.limit, self.limit)
            clipped = np.abs(law + ki * self.integral) > self.output
            outwards = clipped & ((law + ki * self.integral) * (grown - self.integral) > 0.0)
            self.integral = np.where(outwards & self.anti_windup, self.integral, grown)
        return np.clip(law + ki * self.integral, -self.output, self.output)


class Turning:
    """`tactile_control.steering.TurningModel` of N trials."""

    def __init__(self, count: int, settings: SteeringSettings) -> None:
        self.settings = settings
        deviations = np.array([settings.turning_deviation, settings.drift_deviation, np.pi])
        self.assumed = np.diag(1.0 / np.maximum(deviations, 1e-6) ** 2)
        self.mean = self.assumed @ [settings.turning, 0.0, 0.0]
        self.information = np.tile(self.assumed, (count, 1, 1))
        self.weighted = np.tile(self.mean, (count, 1))
        self.way, self.heading = np.zeros((count, 2)), np.zeros(count)
        self.last: tuple[Array, Array] | None = None
        self._solve()

    def update(self, position: Array, angle: Array) -> None:
        s = self.settings
        if self.last is not None:
            moved, normal = position - self.last[0], direction(self.last[1])
            step = np.stack([(moved * across(normal)).sum(axis=1), (moved * normal).sum(axis=1)], axis=1)
            self.heading = self.heading - wrapped(angle - self.last[1])
            self.way, way = self.way + step, np.linalg.norm(step, axis=1)
            kept = np.exp(-way / s.memory)[:, None]
            weight = (np.minimum(1.0, way / s.correlation) / s.heading_deviation**2)[:, None]
            row = np.concatenate([self.way, np.ones((len(way), 1))], axis=1)
            self.information = kept[..., None] * self.information + (1.0 - kept[..., None]) * self.assumed
            self.information += weight[..., None] * row[:, :, None] * row[:, None, :]
            self.weighted = kept * self.weighted + (1.0 - kept) * self.mean
            self.weighted += weight * row * self.heading[:, None]
            self._solve()
        self.last = position.copy(), angle.copy()

    def _solve(self) -> None:
        covariance = np.linalg.inv(self.information)
        fitted = np.einsum("nij,nj->ni", covariance, self.weighted)
        self.variance = covariance[:, 0, 0]
        self.turning, self.drift = np.maximum(0.0, fitted[:, 0]), fitted[:, 1]


@dataclass(frozen=True)
class Variant:
    """What is not a setting of the controllers.

    Attributes
    ----------
    anti_windup : of target alignment
    signed : target alignment is never switched off; it changes its sign with g of the learnt model
    cautious : steering counts the variance of the learnt turning as well
    feedforward : part of the surface's velocity that the follower feeds forward
    safe_shear : of the leader, beyond which it moves more slowly, m
    direction : in which each push is to end (N,), rad from the world's x-axis to its y-axis
    """

    anti_windup: bool = True
    signed: bool = False
    cautious: bool = False
    feedforward: float = 0.0
    safe_shear: float = np.inf
    direction: Array | None = None


@dataclass
class Outcome:
    """Signed errors (N,) mm, as in the report; pushes that missed or lost contact; largest depths, m.

    `turning` is a of the learnt model at the end, where one is learnt, 1/m; `heading` that of the normal,
    rad; `shear` the largest of the leader, m, and `seconds` how long it all took.
    """

    error: Array
    missed: Array
    lost: Array
    depth: list[Array] = field(default_factory=list)
    turning: Array = field(default_factory=lambda: np.zeros(0))
    heading: Array = field(default_factory=lambda: np.zeros(0))
    shear: Array = field(default_factory=lambda: np.zeros(0))
    seconds: Array = field(default_factory=lambda: np.zeros(0))


def push(plant: Plant, leader: SettingGroups, follower: SettingGroups | None, variant: Variant) -> Outcome:
    """Push all trials to the target with the settings of a task file's roles."""
    pusher, holder = _Pusher(plant, leader, variant), _Holder(plant, follower, variant)
    held = HELD if follower is not None else 0.0
    outcome = Outcome(*(np.full(plant.count, value) for value in (np.nan, False, False)))
    outcome.depth = [np.zeros(plant.count) for _ in plant.tips]
    outcome.heading, outcome.shear, outcome.seconds = (np.zeros(plant.count) for _ in range(3))
    done, time = np.zeros(plant.count, bool), 0.0
    while time < LONGEST and not done.all():
        commands = [pusher.step(plant, time - held)]
        if follower is not None:
            commands.append(holder.step(plant))
        moving = ~done
        plant.step([v * moving[:, None] for v, _ in commands], [w * moving for _, w in commands])
        time += DT
        normal, depth = plant.contact(0)
        for arm, largest in enumerate(outcome.depth):
            outcome.depth[arm] = np.where(moving, np.maximum(largest, plant.contact(arm)[1]), largest)
        away = TARGET - plant.tips[0]
        missed = moving & ((away * normal).sum(axis=1) < 0.0)
        ended = moving & (np.linalg.norm(away, axis=1) < TIP) | missed
        error = 1e3 * (normal[:, 0] * away[:, 1] - normal[:, 1] * away[:, 0])
        outcome.error = np.where(ended, error, outcome.error)
        outcome.heading = np.where(ended, np.arctan2(normal[:, 1], normal[:, 0]), outcome.heading)
        outcome.shear = np.where(moving, np.maximum(outcome.shear, np.abs(plant.shears[0])), outcome.shear)
        outcome.seconds += moving * DT
        outcome.missed |= missed
        outcome.lost |= moving & (depth <= 0.0) & (time > held + 2.0 * SETTLING + GAP / APPROACH)
        done |= ended
    outcome.missed |= ~done
    outcome.turning = pusher.model.turning
    return outcome


class _Pusher:
    """The task `pushing` of N trials."""

    def __init__(self, plant: Plant, settings: Any, variant: Variant) -> None:
        self.settings, self.variant = settings, variant
        pid, align, count = settings.pid, settings.alignment, plant.count
        self.tilt = Pid(count, (pid.kp[3], pid.ki[3], pid.kd[3]), pid.integral_limit[3])
        gains, limits = (align.kp, align.ki, align.kd), (align.integral_limit_deg_s, align.output_limit_mm_s)
        self.align = Pid(count, gains, *limits, variant.anti_windup)
        self.model = Turning(count, settings.steering)
        self.touched = np.zeros(count)

    def step(self, plant: Plant, time: float) -> tuple[Array, Array]:
        """Velocities in the world and turnings; nothing before it begins."""
        if time < 0.0:
            return np.zeros((plant.count, 2)), np.zeros(plant.count)
        angle, shear, depth = plant.believed(0)
        touches = plant.contact(0)[1] > 0.0
        self.touched = self.touched + touches * DT
        pressing = self.settings.contact.press_distance / APPROACH
        since = self.touched - pressing - SETTLING
        normal, ramp = direction(angle), np.clip(since / self.settings.task.ramp_time, 0.0, 1.0)
        ramp = ramp**2 * (3.0 - 2.0 * ramp)
        pushes = since > 0.0
        approaching = np.where(self.touched < pressing, APPROACH, 0.0)
        ahead = np.where(pushes, ramp * self.settings.task.speed, approaching)
        origin = plant.tips[0] - shear[:, None] * across(normal) - depth[:, None] * normal
        away = TARGET - origin
        y, z = (away * across(normal)).sum(axis=1), (away * normal).sum(axis=1)
        if self.settings.steering.enabled or self.variant.signed:
            self.model.update(plant.tips[0], angle)
        if self.variant.direction is not None:
            sideways = self._led(y, z, ahead, angle)
        elif self.settings.steering.enabled:
            sideways = self._steered(y, z, ahead)
        else:
            sideways = self._aligned(y, z)
        sideways = ramp * sideways
        if np.isfinite(self.variant.safe_shear):
            slower = np.where(pushes, np.clip(2.0 - np.abs(shear) / self.variant.safe_shear, 0.1, 1.0), 1.0)
            ahead, sideways = slower * ahead, slower * sideways
        turning = self.tilt(np.where(touches, wrapped(angle - plant.headings[0]), 0.0))
        return ahead[:, None] * normal + sideways[:, None] * across(normal), turning

    def _aligned(self, y: Array, z: Array) -> Array:
        distance = np.hypot(y, z)
        wanted = 1e-3 * self.align(-np.degrees(np.arctan2(y, z)))
        if self.variant.signed:
            reach = np.maximum(self.model.turning * distance, 1e-3)
            return wanted * np.clip((reach - 1.0) / reach, -1.0, 1.0)
        return np.where(distance >= self.settings.alignment.cutoff_distance, wanted, 0.0)

    def _steered(self, y: Array, z: Array, ahead: Array) -> Array:
        s, model = self.settings.steering, self.model
        gain = model.turning * z - 1.0
        spread = s.floor**2 + (z**2 * model.variance if self.variant.cautious else 0.0)
        wanted = -(s.gain * y + model.drift * ahead * z) * gain / (gain**2 + spread)
        return np.clip(wanted, -s.limit, s.limit)

    def _led(self, y: Array, z: Array, ahead: Array, angle: Array) -> Array:
        """Towards a direction as well: `SteeringController.step_to_pose`."""
        s, turns = self.settings.steering, wrapped(self.variant.direction - angle)
        turning = np.maximum(self.model.turning, LEAST)
        ends = np.stack([y - TIP * np.sin(turns), z - TIP * np.cos(turns)], axis=1)
        crabs = self.model.drift / turning
        bends = [
            curvature(end, turn, 1.0 / a, crab, s.straight, s.line_length)
            for end, turn, a, crab in zip(ends, turns, turning, crabs, strict=True)
        ]
        return np.clip(-(np.array(bends) + self.model.drift) * ahead / turning, -s.limit, s.limit)


class _Holder:
    """The task `object_tracking` of the follower of N trials: depth and tilt, and feedforward if there is."""

    def __init__(self, plant: Plant, settings: Any, variant: Variant) -> None:
        self.settings, self.variant = settings, variant
        if settings is not None:
            pid = settings.pid
            self.tilt = Pid(plant.count, (pid.kp[3], pid.ki[3], pid.kd[3]), pid.integral_limit[3])
            self.depth = Pid(plant.count, (pid.kp[2], pid.ki[2], pid.kd[2]), pid.integral_limit[2])
        self.surface = np.zeros((plant.count, 3))  # its velocity at the contact, averaged over 0.1 s

    def step(self, plant: Plant) -> tuple[Array, Array]:
        """Velocities in the world and turnings."""
        angle, _, depth = plant.believed(1)
        normal, touches = direction(angle), plant.contact(1)[1] > 0.0
        error = self.settings.servoing.reference[2] - depth
        ahead = np.where(touches, self.depth(np.where(touches, error, 0.0)), APPROACH)
        turning = self.tilt(np.where(touches, wrapped(angle - plant.headings[1]), 0.0))
        turn = plant.motion[:, 2:]
        moved = plant.motion[:, :2] + turn * across(plant.tips[1] - plant.pivot)
        seen = np.concatenate([moved, turn], axis=1)
        self.surface += (1.0 - np.exp(-DT / 0.1)) * (seen / DT - self.surface)
        fed = self.variant.feedforward * self.surface
        return ahead[:, None] * normal + fed[:, :2], turning + fed[:, 2]
