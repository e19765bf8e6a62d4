"""Pushing in the plane, many trials at once in arrays: hundreds of trials of a controller in seconds.

    python bench/control/pushing_plane.py [--trials 25] [--tables single dual]

The physics are those of the simulated pushed objects and of the ideal sensor, reduced to the plane of the
floor (one shear, no roll and pitch), and the controllers those of `tactile_control`, again in arrays; gains,
objects and floors come from the same files, the draws of a trial from the same seed. Left out: the arm's lag,
the safe stage, and the filter, in whose place the errors of a sensor are averaged over four images. Those
errors are the ideal sensor's noise, or what is fitted to the shipped network.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.extend(map(str, Path(__file__).resolve().parents[:2]))

from plane import DT, TARGET, TIP, Array, Physics, Plant, across, direction, wrapped
from shared import Table, parser

from tactile_base.settings import SettingGroups
from tactile_bringup.experiments.pushing import Common, load_tables, task_of
from tactile_control.steering import SteeringSettings
from tactile_sim.pushing_scene import PushVariation

APPROACH, SETTLING, HELD = 0.004, 1.0, 4.0  # m/s; s of settling, and until the follower holds the object
LONGEST = 120.0  # s


class Pid:
    """`tactile_control.pid.TangentPid`, one channel of N trials."""

    def __init__(
        self,
        count: int,
        gains: Sequence[float],
        limit: float,
        output: float = np.inf,
    ) -> None:
        self.gains, self.limit, self.output = gains, limit, output
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
            self.integral = np.where(outwards, self.integral, grown)
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
        self.turning, self.drift = np.maximum(0.0, fitted[:, 0]), fitted[:, 1]


@dataclass
class Outcome:
    """Signed errors (N,) mm, as in the report; pushes that missed; largest depths of each arm, m; seconds."""

    error: Array
    missed: Array
    depth: list[Array]
    seconds: Array


def push(plant: Plant, leader: SettingGroups, follower: SettingGroups | None) -> Outcome:
    """Push all trials to the target with the settings of a task file's roles."""
    pusher, holder = _Pusher(plant, leader), _Holder(plant, follower)
    held = HELD if follower is not None else 0.0
    error, missing, seconds = np.full(plant.count, np.nan), np.zeros(plant.count, bool), np.zeros(plant.count)
    deepest = [np.zeros(plant.count) for _ in plant.tips]
    done, now = np.zeros(plant.count, bool), 0.0
    while now < LONGEST and not done.all():
        commands = [pusher.step(plant, now - held)]
        if follower is not None:
            commands.append(holder.step(plant))
        moving = ~done
        plant.step([v * moving[:, None] for v, _ in commands], [w * moving for _, w in commands])
        now += DT
        normal, _ = plant.contact(0)
        for arm, largest in enumerate(deepest):
            deepest[arm] = np.where(moving, np.maximum(largest, plant.contact(arm)[1]), largest)
        away = TARGET - plant.tips[0]
        passed = moving & ((away * normal).sum(axis=1) < 0.0)
        ended = moving & (np.linalg.norm(away, axis=1) < TIP) | passed
        beside = 1e3 * (normal[:, 0] * away[:, 1] - normal[:, 1] * away[:, 0])
        error = np.where(ended, beside, error)
        seconds += moving * DT
        missing |= passed
        done |= ended
    return Outcome(error, missing | ~done, deepest, seconds)


class _Pusher:
    """The task `pushing` of N trials."""

    def __init__(self, plant: Plant, settings: Any) -> None:
        self.settings = settings
        pid, align, count = settings.pid, settings.alignment, plant.count
        self.tilt = Pid(count, (pid.kp[3], pid.ki[3], pid.kd[3]), pid.integral_limit[3])
        gains, limits = (align.kp, align.ki, align.kd), (align.integral_limit_deg_s, align.output_limit_mm_s)
        self.align = Pid(count, gains, *limits)
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
        if self.settings.steering.enabled:
            self.model.update(plant.tips[0], angle)
            sideways = ramp * self._steered(y, z, ahead)
        else:
            sideways = ramp * self._aligned(y, z)
        turning = self.tilt(np.where(touches, wrapped(angle - plant.headings[0]), 0.0))
        return ahead[:, None] * normal + sideways[:, None] * across(normal), turning

    def _aligned(self, y: Array, z: Array) -> Array:
        distance = np.hypot(y, z)
        wanted = 1e-3 * self.align(-np.degrees(np.arctan2(y, z)))
        return np.where(distance >= self.settings.alignment.cutoff_distance, wanted, 0.0)

    def _steered(self, y: Array, z: Array, ahead: Array) -> Array:
        s, model = self.settings.steering, self.model
        gain = model.turning * z - 1.0
        wanted = -(s.gain * y + model.drift * ahead * z) * gain / (gain**2 + s.floor**2)
        return np.clip(wanted, -s.limit, s.limit)


class _Holder:
    """The task `object_tracking` of the follower of N trials: depth and tilt."""

    def __init__(self, plant: Plant, settings: Any) -> None:
        self.settings = settings
        if settings is not None:
            pid = settings.pid
            self.tilt = Pid(plant.count, (pid.kp[3], pid.ki[3], pid.kd[3]), pid.integral_limit[3])
            self.depth = Pid(plant.count, (pid.kp[2], pid.ki[2], pid.kd[2]), pid.integral_limit[2])

    def step(self, plant: Plant) -> tuple[Array, Array]:
        """Velocities in the world and turnings."""
        angle, _, depth = plant.believed(1)
        normal, touches = direction(angle), plant.contact(1)[1] > 0.0
        error = self.settings.servoing.reference[2] - depth
        ahead = np.where(touches, self.depth(np.where(touches, error, 0.0)), APPROACH)
        turning = self.tilt(np.where(touches, wrapped(angle - plant.headings[1]), 0.0))
        return ahead[:, None] * normal, turning


@dataclass(frozen=True)
class Option:
    """Settings of the arm that pushes on top of the paper's, and what is drawn and assumed."""

    changes: tuple[str, ...] = ()
    variation: PushVariation = field(default_factory=PushVariation)
    physics: Physics = field(default_factory=Physics)


STEERING = ("steering.enabled=true",)
#: More than three times what an experiment draws.
WIDE = PushVariation(friction=0.5, center_of_friction=0.010, placement=0.010, angle_deg=10.0)
OPTIONS = {
    "paper": Option(),
    "paper, errors of the network": Option(physics=Physics(network=True)),
    "paper, wide": Option(variation=WIDE),
    "steering": Option(STEERING),
    "steering, errors of the network": Option(STEERING, physics=Physics(network=True)),
    "steering, noise x 3": Option(STEERING, physics=Physics(noise=3.0)),
    "steering, wide": Option(STEERING, WIDE),
}
LEADER = {"single": "pusher", "dual": "leader"}


def common(table: str, option: Option) -> Common:
    """What the trials of an option have in common."""
    return Common(table, changes=tuple(f"{LEADER[table]}.{change}" for change in option.changes))


def outcome(table: str, option: Option, trials: Sequence[tuple[str, str, int]]) -> Outcome:
    """The pushes of an option."""
    task = task_of(common(table, option))
    follower = task.role("follower").settings if table == "dual" else None
    plant = Plant(trials, 2 if table == "dual" else 1, option.variation, option.physics)
    return push(plant, task.role(LEADER[table]).settings, follower)


def trials_of(table: str, count: int) -> list[tuple[str, str, int]]:
    """Object, floor and seed."""
    return [(*row, seed) for seed in range(1, count + 1) for row in load_tables()[table].rows()]


def cells(found: Outcome, trials: Sequence[tuple[str, str, int]], cpu_s: float) -> list[str]:
    """Of one option: errors of the pushes that arrived, how many missed the target, and how fast all were."""
    arrived = np.flatnonzero(~found.missed)
    if not len(arrived):
        return ["", "", "", "", f"{len(trials)}", "", ""]
    error = np.abs(found.error)
    rows = {trial[:2] for trial in trials}
    means = {row: np.mean([error[k] for k in arrived if trials[k][:2] == row] or 0.0) for row in rows}
    worst = max(sorted(means), key=lambda row: means[row])
    error = error[arrived]
    return [
        f"{error.mean():.2f} ± {error.std():.2f}",
        f"{np.percentile(error, 95):.2f}",
        f"{error.max():.2f}",
        f"{means[worst]:.2f} ({', '.join(worst)})",
        f"{len(trials) - len(arrived)}",
        " / ".join(f"{1e3 * depth.mean():.1f}" for depth in found.depth),
        f"{found.seconds.sum() / cpu_s:.0f}",
    ]


def main() -> None:
    """The command line."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--tables", nargs="+", default=list(LEADER), choices=LEADER)
    arguments.add_argument("--trials", type=int, default=25, help="of each row of a table")
    given = arguments.parse_args()
    for table in given.tables:
        trials = trials_of(table, given.trials)
        heads = (f"{table}", "error", "95 %", "largest", "worst row", "missed", "depth", "times real time")
        printed = Table(heads, f"{len(trials)} trials a row, seeds 1 to {given.trials}; mm")
        for name, option in OPTIONS.items():
            started = time.process_time()
            found = outcome(table, option, trials)
            printed.row(name, *cells(found, trials, time.process_time() - started))


if __name__ == "__main__":
    main()
