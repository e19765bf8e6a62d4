"""Pictures of the simulated sensor for docs/simulator.md.

python docs/images/simulator_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import matplotlib
import numpy as np

from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_perception.markers.detection import density_change, detect
from tactile_perception.markers.view import side_by_side
from tactile_sim.collection import press_then_shear
from tactile_sim.tactip import TacTip

matplotlib.use("Agg")
import matplotlib.pyplot as plt

POSES = {  # mm and degrees
    "no contact": (0, 0, -1, 0, 0, 0),
    "depth 3 mm": (0, 0, 3, 0, 0, 0),
    "depth 6 mm": (0, 0, 6, 0, 0, 0),
    "depth 3 mm, alpha 20 deg": (0, 0, 3, 20, 0, 0),
    "depth 3 mm, shear x 3 mm": (3, 0, 3, 0, 0, 0),
    "depth 5 mm, gamma 15 deg": (0, 0, 5, 0, 0, 15),
}
MARKER_VIEWS = ("depth 3 mm", "depth 3 mm, alpha 20 deg", "depth 3 mm, shear x 3 mm")
DEPTHS = (0.5, 1, 2, 3, 4)  # mm


def images(path: Path) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(10, 5.4))
    for (name, pose), ax in zip(POSES.items(), axes.flat, strict=True):
        sensor = TacTip(seed=1)
        press_then_shear(sensor, np.array(pose) * np.repeat([1e-3, np.pi / 180], 3))
        ax.imshow(sensor.image(), cmap="gray", vmin=0, vmax=255)
        ax.set_title(name, fontsize=9)
        ax.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=90)


def saturation(path: Path) -> None:
    """Equivalent against commanded shear, out and back, by depth."""
    figure, axes = plt.subplots(figsize=(5.5, 4))
    commanded = np.concatenate([np.arange(0, 8, 0.1), np.arange(8, -0.05, -0.1)])
    for depth in DEPTHS:
        axes.plot(commanded, loop(depth, commanded), label=f"{depth} mm")
    axes.plot([0, 8], [0, 8], "k:", lw=0.8)
    axes.set(xlabel="commanded shear (mm)", ylabel="equivalent shear (mm)")
    axes.legend(title="depth")
    figure.tight_layout()
    figure.savefig(path, dpi=100)


def loop(depth: float, commanded: np.ndarray) -> list[float]:
    sensor = TacTip()
    press_then_shear(sensor, np.array([0, 0, depth * 1e-3, 0, 0, 0]))
    surface, start = sensor._surface, sensor._T.copy()
    out = []
    for x in commanded:
        pose = start.copy()
        pose[0, 3] += x * 1e-3
        sensor.advance(surface, pose)
        out.append(sensor.truth().T_fs[0, 3] * 1e3)
    return out


def marker_view(path: Path) -> None:
    """Markers and the change of their density for three contacts."""
    x0, y0, x1, y1 = PreprocessingSettings().bbox
    rows = []
    for name in MARKER_VIEWS:
        sensor = TacTip(seed=1)
        reference = detect(sensor.image()[y0:y1, x0:x1])
        press_then_shear(sensor, np.array(POSES[name]) * np.repeat([1e-3, np.pi / 180], 3))
        image = sensor.image()[y0:y1, x0:x1]
        markers = detect(image)
        both = side_by_side(image, markers, density_change(markers, reference, image.shape))
        cv2.putText(both, name, (450, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.75, (0, 0, 0), 1, cv2.LINE_AA)
        rows.append(cv2.resize(both, None, fx=0.4, fy=0.4, interpolation=cv2.INTER_AREA))
    cv2.imwrite(str(path), np.hstack(rows) & 0xF8, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    images(args.out / "simulator_images.png")
    saturation(args.out / "simulator_saturation.png")
    marker_view(args.out / "marker_view.png")


if __name__ == "__main__":
    main()
