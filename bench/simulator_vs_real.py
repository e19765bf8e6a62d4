"""A simulated sensor beside a real one: same labels, marker by marker and picture by picture.

    PYTHONSAFEPATH= python bench/simulator_vs_real.py DATA/val --sensor tactip_franka [--before default]

Prints and plots the distance between simulated and real markers, by depth and by shear, of one sensor file
or of two ("default" is the built-in sensor); and the gain of the simulated over the real shear response.
The picture with real images stays in the output folder.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import matplotlib
import numpy as np
from real_markers import Tracked, track

from tactile_perception.estimating.preprocessing import Preprocessor
from tactile_sim.collection import Mounting, SensorFile, load_sensor, press_then_shear
from tactile_sim.tactip import TacTip

matplotlib.use("Agg")
import matplotlib.pyplot as plt

DEPTHS = ((0.5, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6))  # mm
SHEARS = ((0, 1), (1, 2), (2, 3), (3, 4), (4, 5))  # mm
INNER_RINGS = 3


class Simulated:
    """Simulated markers for the labels of tracked images, in the order of the real ones."""

    def __init__(self, file: SensorFile, tracked: Tracked) -> None:
        self._file, self._mounting = file, Mounting.of(file.collection)
        self._sensor = TacTip(file.sensor, seed=1)
        rest = self._sensor.marker_pixels
        order = np.linalg.norm(tracked.rest[:, None] - rest[None], axis=2).argmin(axis=1)
        if len(set(order)) != len(order):
            raise SystemExit("the simulated markers at rest are too far from the real ones to be matched")
        self.rest = rest[order]
        self.positions = np.array([self.press(label).marker_pixels[order] for label in tracked.labels])

    def press(self, label: np.ndarray) -> TacTip:
        """The sensor at a label (6,) mm and degrees."""
        pose = label * np.repeat([1e-3, np.pi / 180], 3)
        pose[2] += self._file.collection.depth_offset
        self._sensor.reset()
        press_then_shear(self._sensor, pose, mounting=self._mounting)
        return self._sensor


def within(values: np.ndarray, band: tuple[float, float]) -> np.ndarray:
    return (values >= band[0]) & (values < band[1])


def rms(distance: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(distance**2))) if np.isfinite(distance).any() else np.nan


def shear_gain(simulated: np.ndarray, real: np.ndarray) -> float:
    """Simulated over real displacement of the inner markers (samples, markers, 2), by least squares."""
    return float(np.nansum(simulated * real) / np.nansum(real * real))


def tell(name: str, tracked: Tracked, simulated: Simulated) -> np.ndarray:
    """Print the errors of one sensor; gives the RMS (depths, 1 + shears) of all and by shear."""
    at_rest = np.linalg.norm(simulated.rest - tracked.rest, axis=1)
    error = np.linalg.norm(simulated.positions - tracked.positions, axis=2)
    moved = np.linalg.norm(tracked.positions - tracked.rest, axis=2)
    inner = tracked.ring < INNER_RINGS
    shear = np.hypot(*tracked.labels[:, :2].T)
    print(
        f"{name}: RMS {rms(error):.2f} px, median {np.nanmedian(error):.2f} px; at rest {rms(at_rest):.2f} px"
    )
    print("depth mm    n  real shift | error: median   RMS  95 % | gain of shear | RMS by shear "
          + "  ".join(f"{a}-{b}" for a, b in SHEARS))  # fmt: skip
    table = []
    for band in DEPTHS:
        deep = within(tracked.labels[:, 2], band)
        gain = shear_gain(
            (simulated.positions[deep] - simulated.rest)[:, inner],
            (tracked.positions[deep] - tracked.rest)[:, inner],
        )
        row = [rms(error[deep])] + [rms(error[deep & within(shear, one)]) for one in SHEARS]
        table.append(row)
        print(
            f"{band[0]:3}-{band[1]} {deep.sum():6d} {rms(moved[deep]):10.1f} | "
            f"{np.nanmedian(error[deep]):13.2f} {row[0]:5.2f} {np.nanpercentile(error[deep], 95):5.1f} | "
            f"{gain:13.2f} |             " + " ".join(f"{value:5.2f}" for value in row[1:])
        )
    return np.array(table)


def plot(tables: dict[str, np.ndarray], path: Path) -> None:
    """RMS by depth for each sensor, and by depth and shear for the last one."""
    figure, axes = plt.subplots(
        1, 1 + len(tables), figsize=(4 * (1 + len(tables)), 3.4), layout="constrained"
    )
    middle = [sum(band) / 2 for band in DEPTHS]
    for name, table in tables.items():
        axes[0].plot(middle, table[:, 0], ".-", label=name)
    axes[0].set(xlabel="depth (mm)", ylabel="simulated - real markers, RMS (px)", ylim=(0, None))
    axes[0].legend()
    top = max(np.nanmax(table) for table in tables.values())
    for axis, (name, table) in zip(axes[1:], tables.items(), strict=True):
        axis.imshow(table[:, 1:].T, origin="lower", vmin=0, vmax=top, cmap="magma_r", aspect="auto")
        for (row, column), value in np.ndenumerate(table[:, 1:]):
            dark = value > 0.6 * top
            axis.text(row, column, f"{value:.1f}", ha="center", va="center", color="w" if dark else "k")
        axis.set_xticks(range(len(DEPTHS)), [f"{a:g}-{b}" for a, b in DEPTHS])
        axis.set_yticks(range(len(SHEARS)), [f"{a}-{b}" for a, b in SHEARS])
        axis.set(xlabel="depth (mm)", ylabel="shear (mm)", title=f"{name}: RMS (px)")
    figure.savefig(path, dpi=90)


def side_by_side(simulated: Simulated, tracked: Tracked, path: Path) -> None:
    """Real, simulated, and both laid over each other (real blue, simulated red), for eight contact poses."""
    preprocessor = Preprocessor(tracked.folder.preprocessing)
    rows = []
    for k in np.linspace(0, len(tracked.index) - 1, 8).astype(int):
        real = tracked.folder.image(tracked.index[k])
        ours = preprocessor.binary(simulated.press(tracked.labels[k]).image())
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
    parser.add_argument("--sensor", default="default", help="sensor name or file (default: the built-in one)")
    parser.add_argument("--before", help="another one to compare with")
    parser.add_argument("--out", type=Path, default=Path("out/simulator_vs_real"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)

    tracked = track(args.data, args.samples)
    tables = {}
    for name in filter(None, (args.before, args.sensor)):
        simulated = Simulated(SensorFile() if name == "default" else load_sensor(name), tracked)
        tables[Path(name).stem] = tell(name, tracked, simulated)
    plot(tables, args.out / "simulator_vs_real.png")
    side_by_side(simulated, tracked, args.out / "side_by_side.png")
    print(args.out / "simulator_vs_real.png", args.out / "side_by_side.png")


if __name__ == "__main__":
    main()
