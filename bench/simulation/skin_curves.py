"""Force curves of the simulated skin, from which the constants of `SkinForces` and of the scenes are read.

OMP_NUM_THREADS=1 python bench/simulation/skin_curves.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_geometry import se3
from tactile_scene.shapes import make_surface
from tactile_sim.tactip import TacTip

DEPTHS = np.arange(1.0, 9.0)  # mm
SHEAR = 0.3  # mm


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
    table = Table((f"depth in a {name}", "normal force (N)", "tangential stiffness (N/m)"), "no noise")
    for depth, force, stiff in zip(DEPTHS, press, stiffness, strict=True):
        table.row(f"{depth:g} mm", f"{force:.3f}", f"{stiff:.1f}")
    print()
    for label, values, unit in (("normal force", press, "N"), ("tangential stiffness", stiffness, "N/m")):
        exponent, log_value = np.polyfit(np.log(DEPTHS / 6.0), np.log(values), 1)
        off = np.abs(np.exp(log_value) * (DEPTHS / 6.0) ** exponent / values - 1).max()
        print(f"{label}: {np.exp(log_value):.4g} {unit} x (depth / 6 mm)^{exponent:.3f}, "
              f"within {100 * off:.0f} % of these")  # fmt: skip


def main() -> None:
    """Print both curves."""
    parser(__doc__ or "").parse_args()
    curve("plane", "plane", {}, 0.0)
    curve("ball of 70 mm", "sphere", {"radius": 0.035}, 0.035)


if __name__ == "__main__":
    main()
