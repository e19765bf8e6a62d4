"""Does the frame {s} of a data folder's labels sit in the centre of the dome or in its apex?

    PYTHONSAFEPATH= python bench/sensor_frame_evidence.py DATA/train [--samples 2500] [--out out/sensor_frame]

If a label's angles turned the sensor about its apex, then a contact labelled with depth z at tilt t would
press the dome R (1 - cos t) deeper than one without tilt: 1.9 mm at 25 degrees. The mean marker
displacement says how deep a contact is. Contacts with tilt below 8 degrees calibrate it; the extra depth
that best explains the displacements at larger tilts is then what the labels leave out. The same is done
with simulated images of the same labels, made either way, which shows what the measure makes of the two
cases.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np
from real_markers import track
from scipy.optimize import minimize_scalar

from tactile_sim.collection import press_then_shear
from tactile_sim.tactip import TacTip

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TILT_BINS = ((8, 12), (12, 16), (16, 20), (20, 25))  # deg
CALIBRATION_TILT = 8.0  # deg
DEPTHS = (0.5, 2.5)  # mm, of the contacts that are judged
RADIUS_MM = 20.0


def extra_depth(labels: np.ndarray, displacement: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Extra depth (mm) and its standard error by tilt bin, (bins, 2)."""
    tilt = tilt_of(labels)
    flat = tilt < CALIBRATION_TILT
    curve = np.polynomial.Polynomial.fit(labels[flat, 2], displacement[flat], 4)
    out = []
    for low, high in TILT_BINS:
        chosen = np.flatnonzero((tilt >= low) & (tilt < high) & (labels[:, 2] < DEPTHS[1]))
        found = [_shift(curve, labels[k, 2], displacement[k]) for k in [chosen, *_resampled(chosen, rng)]]
        out.append((found[0], np.std(found[1:])))
    return np.array(out)


def _shift(curve: np.polynomial.Polynomial, depth: np.ndarray, displacement: np.ndarray) -> float:
    def misfit(shift: float) -> float:
        return float(np.sum((curve(depth + shift) - displacement) ** 2))

    return float(minimize_scalar(misfit, bounds=(-0.5, 3.0), method="bounded").x)


def _resampled(chosen: np.ndarray, rng: np.random.Generator, times: int = 50) -> list[np.ndarray]:
    return [rng.choice(chosen, len(chosen)) for _ in range(times)]


def tilt_of(labels: np.ndarray) -> np.ndarray:
    """Angle (deg) between the sensor's axis and the surface's normal."""
    alpha, beta = np.radians(labels[:, 3:5]).T
    return np.degrees(np.arccos(np.cos(alpha) * np.cos(beta)))


def simulated(labels: np.ndarray, about_apex: bool) -> np.ndarray:
    """Mean marker displacement (px) of simulated images with these labels."""
    sensor = TacTip()
    rest = sensor.marker_pixels
    out = np.empty(len(labels))
    for i, label in enumerate(labels):
        pose = label * np.repeat([1e-3, np.pi / 180], 3)
        if about_apex:
            pose[2] += 1e-3 * RADIUS_MM * (1 - np.cos(np.radians(tilt_of(label[None])[0])))
        sensor.reset()
        press_then_shear(sensor, pose)
        out[i] = np.linalg.norm(sensor.marker_pixels - rest, axis=1).mean()
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, default=2500, help="images used (default 2500)")
    parser.add_argument("--out", type=Path, default=Path("out/sensor_frame"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    tracked = track(args.data, args.samples)
    used = tracked.labels[:, 2] < DEPTHS[1] + 2.0
    labels = tracked.labels[used]
    distance = np.linalg.norm(tracked.positions[used] - tracked.rest, axis=2)
    rows = {"real": np.nanmean(distance, axis=1)}
    rows |= {
        f"simulated, labels about the {name}": simulated(labels, name == "apex")
        for name in ("centre", "apex")
    }

    rng = np.random.default_rng(0)
    middle = [(low + high) / 2 for low, high in TILT_BINS]
    figure, axes = plt.subplots(figsize=(6, 4))
    geometric = RADIUS_MM * (1 - np.cos(np.radians(middle)))
    axes.plot(middle, geometric, "k--", label="R (1 - cos t): turned about the apex")
    print(
        f"{len(labels)} contacts; extra depth (mm) at tilt",
        *[f"{low}-{high} deg" for low, high in TILT_BINS],
        sep="  ",
    )
    for (name, displacement), style in zip(rows.items(), ("ko-", "C0s-", "C1^-"), strict=True):
        found = extra_depth(labels, displacement, rng)
        axes.errorbar(middle, found[:, 0], found[:, 1], fmt=style, capsize=3, label=name)
        print(f"{name:36s}", *[f"{value:6.2f} +- {error:.2f}" for value, error in found])
    print(f"{'R (1 - cos t)':36s}", *[f"{value:6.2f}        " for value in geometric])
    axes.set(xlabel="tilt (deg)", ylabel="depth that the label leaves out (mm)")
    axes.legend()
    figure.tight_layout()
    figure.savefig(args.out / "sensor_frame.png", dpi=120)
    print(args.out / "sensor_frame.png")


if __name__ == "__main__":
    main()
