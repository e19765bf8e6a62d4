"""What the marker view costs per frame, and how exact the detection is.

    python bench/perception/markers.py [--frames 200]

Simulated contacts over the paper's ranges: processor time of each stage, and markers missed, invented and
displaced against the simulator's own, in camera images and in pre-processed ones.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_perception.estimating.preprocessing import Preprocessor
from tactile_perception.markers.detection import density_change, detect
from tactile_perception.markers.view import side_by_side
from tactile_scene.sampling import SamplingSettings, pose_of
from tactile_sim.collection import press_then_shear
from tactile_sim.tactip import TacTip

SAME = 4.0  # px, within which a marker found is one of the simulator's


def timed(times: list[float], action: Callable[[], Any]) -> Any:
    started = time.process_time()
    result = action()
    times.append(time.process_time() - started)
    return result


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--frames", type=int, default=200)
    args = arguments.parse_args()
    cv2.setNumThreads(1)
    sensor, preprocessor = TacTip(seed=1), Preprocessor()
    reference = detect(sensor.image())
    times: dict[str, list[float]] = {name: [] for name in ("detect, camera image", "detect, pre-processed",
                                                           "density change", "pictures")}  # fmt: skip
    errors: dict[str, list[np.ndarray]] = {"camera image": [], "pre-processed": []}
    for index in range(args.frames):
        sensor.reset(seed=index)
        press_then_shear(sensor, pose_of(SamplingSettings(), 1, index))
        image, true = sensor.image(), sensor.marker_pixels
        binary = preprocessor.processed(image)
        markers = timed(times["detect, camera image"], lambda image=image: detect(image))
        cropped = timed(times["detect, pre-processed"], lambda binary=binary: detect(binary))
        change = timed(
            times["density change"], lambda m=markers, s=image.shape: density_change(m, reference, s)
        )
        timed(times["pictures"], lambda i=image, m=markers, c=change: side_by_side(i, m, c))
        offset = np.array(preprocessor.settings.bbox[:2])
        for name, centers in (("camera image", markers.centers), ("pre-processed", cropped.centers + offset)):
            missed, invented = cKDTree(centers).query(true)[0], cKDTree(true).query(centers)[0]
            near = missed[missed < SAME]
            errors[name].append(
                np.array([np.sum(missed >= SAME), np.sum(invented >= SAME), np.sum(near**2), len(near)])
            )
    table = Table(("of", "missed (%)", "invented (%)", "RMS (px)"), f"{args.frames} frames, seed 1")
    for name, rows in errors.items():
        missed, invented, square, count = np.sum(rows, axis=0)
        lost, more = (100 * number / (missed + count) for number in (missed, invented))
        table.row(name, f"{lost:.2f}", f"{more:.2f}", f"{np.sqrt(square / count):.3f}")
    table = Table(("stage", "processor time, ms"), f"medians of {args.frames} frames", timed=True)
    for name, seconds in times.items():
        table.row(name, f"{1e3 * np.median(seconds):.2f}")


if __name__ == "__main__":
    main()
