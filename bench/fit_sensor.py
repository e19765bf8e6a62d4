"""Fit marker layout and camera of the simulated sensor to the marker positions of a real one.

    PYTHONPATH=. python bench/fit_sensor.py DATA/train [--contacts 60] [--depth-offset -0.4]

Simulates contacts with the labels of real images, then fits what projects them (not the mechanics) by soft-L1
least squares, and prints settings beside the present defaults.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from real_markers import Tracked, track
from scipy.optimize import least_squares

from tactile_drivers.sim.camera import Camera, CameraSettings
from tactile_drivers.sim.collection import press_then_shear
from tactile_drivers.sim.markers import Markers, MarkerSettings
from tactile_drivers.sim.skin import SkinSettings, load_skin
from tactile_drivers.sim.tactip import TacTip

# name, unit of the search, lower and upper bound; k1 is the first coefficient of the distortion
CAMERA = (
    ("focal_length", 100.0, 200, 3000), ("distance", 0.01, 0.008, 0.1), ("k1", 0.3, -1, 1),
    ("center_column", 3.0, 300, 360), ("center_row", 3.0, 210, 270), ("rotation_deg", 2.0, -70, -40),
)  # fmt: skip
MARKERS = (("pitch_deg", 0.3, 2.5, 7.0), ("azimuth_deg", 2.0, 20, 80))


def displacements(tracked: Tracked, chosen: np.ndarray, depth_offset: float) -> np.ndarray:
    """Skin displacements (contacts, nodes, 3) with the labels of the chosen images."""
    sensor = TacTip()
    out = []
    for label in tracked.labels[chosen]:
        pose = label * np.repeat([1e-3, np.pi / 180], 3)
        pose[2] += 1e-3 * depth_offset
        sensor.reset()
        press_then_shear(sensor, pose)
        out.append(sensor.displacement.astype(np.float32))
    return np.array(out)


def settings_of(values: np.ndarray) -> tuple[CameraSettings, MarkerSettings]:
    named = dict(zip([row[0] for row in CAMERA + MARKERS], map(float, values), strict=True))
    distortion = (named.pop("k1"), 0.0)
    markers = {row[0]: named.pop(row[0]) for row in MARKERS}
    return CameraSettings(distortion=distortion, **named), MarkerSettings(**markers)


def present() -> np.ndarray:
    camera, markers = CameraSettings(), MarkerSettings()
    values = [camera.distortion[0] if row[0] == "k1" else getattr(camera, row[0]) for row in CAMERA]
    return np.array(values + [getattr(markers, row[0]) for row in MARKERS])


def fit(tracked: Tracked, chosen: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best values, and the distances (px) that are left."""
    skin, tip = load_skin(), SkinSettings()
    real = tracked.positions[chosen]
    seen = np.isfinite(real[..., 0])
    scale, low, high = np.array([row[1:] for row in CAMERA + MARKERS]).T

    def residual(scaled: np.ndarray) -> np.ndarray:
        camera_settings, marker_settings = settings_of(scaled * scale)
        markers, camera = (
            Markers(marker_settings, skin, tip.radius, tip.skin_thickness),
            Camera(camera_settings),
        )
        pixels = np.array([camera.project(markers.positions(one))[0] for one in moved])
        return (pixels - real)[seen].ravel()

    start = np.clip(present(), low + 1e-3 * scale, high - 1e-3 * scale) / scale
    found = least_squares(
        residual,
        start,
        bounds=(low / scale, high / scale),
        loss="soft_l1",
        f_scale=3.0,
        diff_step=1e-4,
        max_nfev=20,
    )
    return found.x * scale, np.linalg.norm(residual(found.x).reshape(-1, 2), axis=1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--contacts", type=int, default=60, help="images fitted (default 60)")
    parser.add_argument(
        "--depth-offset", type=float, default=-0.4, help="mm added to the labels' depth (default -0.4)"
    )
    args = parser.parse_args()
    tracked = track(args.data, 1200)
    chosen = np.random.default_rng(0).choice(len(tracked.index), args.contacts, replace=False)
    found, left = fit(tracked, chosen, displacements(tracked, chosen, args.depth_offset))
    for row, value, default in zip(CAMERA + MARKERS, found, present(), strict=True):
        print(f"{row[0]:14s} {value:10.4f}   (default {default:g})")
    print(f"left: median {np.median(left):.2f} px, 95 % {np.percentile(left, 95):.2f} px")


if __name__ == "__main__":
    main()
