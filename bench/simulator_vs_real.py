"""The simulated sensor beside a real one: same labels, marker by marker and picture by picture.

    PYTHONPATH=. python bench/simulator_vs_real.py DATA/train [--samples 800] [--out out/simulator_vs_real]

Prints and plots, by depth: how far markers are displaced and how far the simulated ones are off; and the
gain of the simulated over the real shear response. `--depth-offset` (mm) is added to the labels' depth in
simulation, because a real arm's zero of depth is where somebody set it. The picture with real images stays
in the output folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from real_markers import Tracked, track

from tactile_drivers.sim.collection import press_then_shear
from tactile_drivers.sim.tactip import TacTip
from tactile_filter import se3
from tactile_perception.estimator import Estimator, shipped_model
from tactile_perception.preprocessing import Preprocessor

matplotlib.use("Agg")
import matplotlib.pyplot as plt

BANDS = ((0.5, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6))  # mm
INNER_RINGS = 3


def simulate(sensor: TacTip, label: np.ndarray, depth_offset: float) -> np.ndarray:
    """Marker positions (331, 2) px in rings of the sensor's own order."""
    pose = label * np.repeat([1e-3, np.pi / 180], 3)
    pose[2] += 1e-3 * depth_offset
    sensor.reset()
    press_then_shear(sensor, pose)
    return sensor.marker_pixels


def matched(sensor: TacTip, tracked: Tracked) -> np.ndarray:
    """For each tracked marker the simulated one at the same place at rest."""
    sensor.reset()
    rest = sensor.marker_pixels
    order = np.linalg.norm(tracked.rest[:, None] - rest[None], axis=2).argmin(axis=1)
    if len(set(order)) != len(order):
        raise RuntimeError("the simulated markers at rest are too far from the real ones to be matched")
    print(f"at rest: median distance {np.median(np.linalg.norm(tracked.rest - rest[order], axis=1)):.2f} px")
    return order


def shear_gain(simulated: np.ndarray, real: np.ndarray) -> float:
    """Simulated over real displacement of the inner markers (samples, markers, 2), by least squares."""
    return float(np.nansum(simulated * real) / np.nansum(real * real))


def statistics(tracked: Tracked, simulated: np.ndarray, rest: np.ndarray) -> list[tuple[float, ...]]:
    rows = []
    inner = tracked.ring < INNER_RINGS
    print("depth mm   samples  real shift px  error px: median  p95   gain of the shear response")
    for low, high in BANDS:
        chosen = (tracked.labels[:, 2] >= low) & (tracked.labels[:, 2] < high)
        error = np.linalg.norm(simulated[chosen] - tracked.positions[chosen], axis=2)
        moved = np.linalg.norm(tracked.positions[chosen] - tracked.rest, axis=2)
        gain = shear_gain(
            (simulated[chosen] - rest)[:, inner],
            (tracked.positions[chosen] - tracked.rest)[:, inner],
        )
        shift, median, worst = np.nanmedian(moved), np.nanmedian(error), np.nanpercentile(error, 95)
        rows.append(((low + high) / 2, shift, median, worst, gain))
        print(
            f"{low:3.1f}-{high:3.1f} {chosen.sum():11d} {shift:13.1f} {median:17.1f} {worst:7.1f} {gain:9.2f}"
        )
    return rows


def plot(rows: list[tuple[float, ...]], path: Path) -> None:
    depth, shift, median, high, gain = np.array(rows).T
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5))
    axes[0].plot(depth, shift, "k.-", label="displacement, real (median)")
    axes[0].plot(depth, median, "C0.-", label="simulated - real (median)")
    axes[0].plot(depth, high, "C0.:", label="simulated - real (95 %)")
    axes[0].set(xlabel="depth (mm)", ylabel="px of 640 x 480")
    axes[0].legend()
    axes[1].plot(depth, gain, "C1.-")
    axes[1].axhline(1.0, color="k", lw=0.5)
    axes[1].set(xlabel="depth (mm)", ylabel="simulated / real shear response")
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def transfer(tracked: Tracked, model: Path) -> None:
    """Errors on the real images of a network that has seen simulated ones only."""
    estimator = Estimator(model)
    found = []
    for i in tracked.index:
        T_fs = se3.inverse(estimator.estimate_processed(tracked.folder.image(i)).mean)
        found.append(se3.euler_from_pose(T_fs) / np.repeat([1e-3, np.pi / 180], 3))
    error = np.array(found) - tracked.labels
    correlation = [np.corrcoef(np.array(found)[:, k], tracked.labels[:, k])[0, 1] for k in range(6)]
    print(f"{model.name} on the real images: x y z (mm) alpha beta gamma (deg)")
    for name, values in (
        ("mean error", error.mean(0)),
        ("MAE", np.abs(error).mean(0)),
        ("correlation", correlation),
    ):
        print(f"{name:12s}", *[f"{value:7.2f}" for value in values])


def side_by_side(sensor: TacTip, tracked: Tracked, depth_offset: float, path: Path) -> None:
    """Real, simulated, and both laid over each other (real blue, simulated red), for eight contact poses."""
    preprocessor = Preprocessor(tracked.folder.preprocessing)
    rows = []
    for k in np.linspace(0, len(tracked.index) - 1, 8).astype(int):
        simulate(sensor, tracked.labels[k], depth_offset)
        real = tracked.folder.image(tracked.index[k])
        ours = preprocessor.binary(sensor.image())
        overlay = np.dstack([real, np.zeros_like(real), ours])
        text = " ".join(f"{value:.1f}" for value in tracked.labels[k])
        panel = np.hstack(
            [cv2.cvtColor(real, cv2.COLOR_GRAY2BGR), cv2.cvtColor(ours, cv2.COLOR_GRAY2BGR), overlay]
        )
        rows.append(cv2.putText(panel, text, (4, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 255, 255), 1))
    half = len(rows) // 2
    cv2.imwrite(str(path), np.hstack([np.vstack(rows[:half]), np.vstack(rows[half:])]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--samples", type=int, default=800, help="images compared (default 800)")
    parser.add_argument(
        "--depth-offset", type=float, default=0.0, help="mm added to the labels' depth in simulation"
    )
    parser.add_argument(
        "--model", type=Path, default=shipped_model(), help="network that is tried on real images"
    )
    parser.add_argument("--out", type=Path, default=Path("out/simulator_vs_real"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    tracked = track(args.data, args.samples)
    sensor = TacTip(seed=1)
    order = matched(sensor, tracked)
    rest = sensor.marker_pixels[order]
    simulated = np.array([simulate(sensor, label, args.depth_offset)[order] for label in tracked.labels])
    plot(statistics(tracked, simulated, rest), args.out / "simulator_vs_real.png")
    transfer(tracked, args.model)
    side_by_side(sensor, tracked, args.depth_offset, args.out / "side_by_side.png")
    print(args.out / "simulator_vs_real.png", args.out / "side_by_side.png")


if __name__ == "__main__":
    main()
