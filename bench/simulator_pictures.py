"""Pictures of the simulated sensor for docs/simulator.md.

PYTHONPATH=. python bench/simulator_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib
import numpy as np

from tactile_drivers.sim.collection import press_then_shear
from tactile_drivers.sim.tactip import TacTip

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    images(args.out / "simulator_images.png")
    saturation(args.out / "simulator_saturation.png")


if __name__ == "__main__":
    main()
