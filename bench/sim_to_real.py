"""Errors of a network on real images: of one trained on simulated ones they tell what a simulator is worth.

    python bench/sim_to_real.py DATA/val --model MODEL.onnx [--limit 1000]

Prints mean absolute error and mean error by component and depth, and how much of the error in angle follows
the label's shear.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from tactile_perception.datasets.dataset import open_folder
from tactile_perception.estimating.estimator import Estimator, shipped_model
from tactile_perception.estimating.labels import COMPONENTS, labels_from_euler, network_from_pose

DEPTHS = ((0.5, 1), (1, 2), (2, 3), (3, 4), (4, 5), (5, 6.5))  # mm


def errors(folder: Path, model: Path, limit: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Labels (n, 6) xi_sf in mm and rad, and errors of the network's means (n, 6)."""
    data, estimator = open_folder(folder), Estimator(model)
    order = np.random.default_rng(0).permutation(len(data))[:limit]
    labels, found = labels_from_euler(data.euler_mm_deg[order]), []
    for i in order:
        found.append(network_from_pose(estimator.estimate_processed(data.image(i)).mean))
    return labels, np.array(found) - labels


def shown(values: np.ndarray) -> str:
    return " ".join(f"{value:8.4f}" for value in values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--model", type=Path, default=shipped_model())
    parser.add_argument("--limit", type=int, help="images (default: all)")
    args = parser.parse_args()
    labels, error = errors(args.data, args.model, args.limit)
    print(f"{len(labels)} images   " + " ".join(f"{name:>8s}" for name in COMPONENTS) + "   (mm, rad)")
    print("MAE           " + shown(np.abs(error).mean(axis=0)))
    print("mean error    " + shown(error.mean(axis=0)))
    depth = -labels[:, 2]
    for low, high in DEPTHS:
        chosen = (depth >= low) & (depth < high)
        print(f"MAE {low:3}-{high:<3} mm" + shown(np.abs(error[chosen]).mean(axis=0)))
    deep = depth > 2.5
    for angle, shear in ((3, 1), (4, 0)):
        slope = np.polyfit(labels[deep, shear], error[deep, angle], 1)[0]
        print(f"{COMPONENTS[angle]} per mm of {COMPONENTS[shear]}, deeper than 2.5 mm: {slope:.4f} rad")


if __name__ == "__main__":
    main()
