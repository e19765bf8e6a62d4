"""Curves of the simulated skin for `HeldSettings`; inertia beside weight; how hard an object must be pressed.

OMP_NUM_THREADS=1 python bench/held_objects.py
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq

from tactile_drivers.scene import load_scene
from tactile_drivers.shapes import make_surface
from tactile_drivers.sim.held import GRAVITY, HeldObject, HeldSettings
from tactile_drivers.sim.tactip import TacTip
from tactile_geometry import se3

DEPTHS = np.arange(1.0, 9.0)  # mm
SHEAR = 0.3  # mm
# Amplitude, phase and period of the leader's periodic velocity (paper, "Task 1: Object pose tracking").
AMPLITUDE = np.array([0.075, 0.075, 0.075, *np.radians([25.0] * 3)])
PHASE = np.array([np.pi / 2, 0, 0, 0, 0, 0])
PERIOD = 30.0  # s
STEP = 0.05  # s
SCENES = ("tracking_cube", "tracking_mustard", "tracking_ball")


def curve(name: str, kind: str, parameters: dict[str, float], top: float) -> None:
    """Normal force and shear stiffness of the skin pressed on a shape whose top is at z = `top`."""
    sensor, shape = TacTip(), make_surface(kind, parameters)
    facing_down = se3.pose_from_euler([0, 0, top + sensor.settings.skin.radius, np.pi, 0, 0])
    press, stiffness = [], []
    for depth in DEPTHS:
        sensor.reset()
        for x, d in ((0.0, -1.0), (0.0, depth)):
            sensor.advance(shape, facing_down @ se3.pose_from_euler([x * 1e-3, 0, d * 1e-3, 0, 0, 0]))
        press.append(sensor.truth().normal_force)
        sheared = se3.pose_from_euler([SHEAR * 1e-3, 0, depth * 1e-3, 0, 0, 0])
        sensor.advance(shape, facing_down @ sheared)
        stiffness.append(sensor.truth().tangential_force / (SHEAR * 1e-3))
    print(f"{name}: depth mm, normal force N, tangential stiffness N/m")
    for row in zip(DEPTHS, press, stiffness, strict=True):
        print("  {:4.0f} {:7.3f} {:7.1f}".format(*row))
    for label, values, unit in (("normal force", press, "N"), ("tangential stiffness", stiffness, "N/m")):
        exponent, log_value = np.polyfit(np.log(DEPTHS / 6.0), np.log(values), 1)
        off = np.abs(np.exp(log_value) * (DEPTHS / 6.0) ** exponent / values - 1).max()
        print(f"  {label}: {np.exp(log_value):.4g} {unit} x (depth / 6 mm)^{exponent:.3f}, "
              f"within {100 * off:.0f} % of these")  # fmt: skip


def trajectory(speed: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Poses (n, 4, 4) of the plate over one period, from standing upright, and its twists (n, 6)."""
    times = np.arange(0.0, PERIOD, STEP * speed)
    twists = speed * 2 * np.pi / PERIOD * AMPLITUDE * np.cos(2 * np.pi * times[:, None] / PERIOD + PHASE)
    poses = [se3.pose_from_euler([0, 0, 0, np.pi / 2, 0, 0])]
    for twist in twists[:-1]:
        poses.append(poses[-1] @ se3.exp(STEP * twist))
    return np.array(poses), twists


def inertia() -> None:
    """Largest acceleration of an object 60 mm in front of the plate, beside gravity."""
    print("speed, largest acceleration mm/s^2, of gravity %")
    ahead = np.array([0.0, 0.0, 0.06, 1.0])
    for speed in (0.5, 1.0, 2.0, 4.0):
        poses, _ = trajectory(speed)
        way = (poses @ ahead)[:, :3]
        acceleration = np.linalg.norm(np.diff(way, 2, axis=0), axis=1).max() / STEP**2
        print(f"  {speed:3.1f} {1e3 * acceleration:8.1f} {-100 * acceleration / GRAVITY[2]:8.2f}")


def least_press(settings: HeldSettings, poses: np.ndarray, share: float) -> float:
    """Normal force (N) above which it neither slips nor tilts anywhere on the way.

    `share` of the weight along the plate is carried by the tip, the rest by the plate.
    """

    def worst(press: float) -> float:
        margins = []
        for T in poses:
            body = HeldObject(settings.replaced(hand_time=0.0))
            weight = settings.mass * T[:3, :3].T @ np.array(GRAVITY)
            force = np.array([*(-share * weight[:2]), -press])
            body.step(T, force, np.array([0.0, 0.0, 2 * settings.standoff]), STEP)
            margins.append(body.load.margin if body.load else -1.0)
        return max(min(margins), -10.0)

    return float(brentq(worst, 1e-3, 100.0, xtol=1e-3))


def holding() -> None:
    poses = trajectory()[0][::20]
    print("object, mass kg, least press N on the way: tip without shear, with half the weight; N at 6 mm")
    for name in SCENES:
        body = next(iter(load_scene(name).bodies.values()))
        settings = body.motion_settings.checked(HeldSettings, body.motion_settings.values)
        alone, half = (least_press(settings, poses, share) for share in (0.0, 0.5))
        print(f"  {name:16} {settings.mass:6.3f} {alone:6.2f} {half:6.2f} {settings.normal_force(6e-3):6.2f}")


def main() -> None:
    curve("plane", "plane", {}, 0.0)
    curve("ball of 70 mm", "sphere", {"radius": 0.035}, 0.035)
    inertia()
    holding()


if __name__ == "__main__":
    main()
