"""What each stage of an estimate costs on one core, image after image and with the pauses of a camera.

    python bench/perception/stages.py [--model FILE] [--images 400] [--rate 60] [--opencv]

A node at 60 Hz sleeps 14 of 16 ms and finds its caches taken by others and its core slowed down: the second
column is what it pays. Images are simulated. `--opencv` adds the same pre-processing by OpenCV's functions.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_drivers.shapes.plane import Plane
from tactile_drivers.sim.tactip import TacTip
from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.preprocessing import PreprocessingSettings, as_input
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings

STAGES = ("pre-processing", "presence", "network", "conversion", "all")
_CAPTURED = 10


def main() -> None:
    arguments = _arguments()
    images = simulated_images(24)
    estimator = Estimator(arguments.model or "", arguments.threads)
    opencv = OpenCvPreprocessing(estimator.preprocessor.settings) if arguments.opencv else None
    measured = [
        stage_times(estimator, images, arguments.images, rate, opencv) for rate in (0, arguments.rate)
    ]
    print(f"{estimator.path.name}, {arguments.threads} thread(s)")
    print(f"{'ms: p50 / p99':26s}{'one after another':>20s}{f'at {arguments.rate:g} Hz':>20s}")
    for name in measured[0]:
        print(f"{name:26s}" + "".join(f"{_percentiles(times[name]):>20s}" for times in measured))


def stage_times(
    estimator: Estimator,
    images: NDArray[np.uint8],
    count: int,
    rate: float = 0.0,
    opencv: OpenCvPreprocessing | None = None,
) -> dict[str, list[float]]:
    """Seconds of each stage of the estimator node's work on `count` images.

    Parameters
    ----------
    images : (N, 480, 640), the first `_CAPTURED` without contact
    rate : images a second; 0: one after another
    """
    presence = ContactPresence(PresenceSettings(reference_frames=_CAPTURED))
    for image in images[:_CAPTURED]:
        presence.update(estimator.preprocessor(image))
    result: dict[str, list[float]] = {name: [] for name in STAGES + (("OpenCV",) if opencv else ())}
    due = time.perf_counter()
    for number in range(count):
        due += 1.0 / rate if rate else 0.0
        time.sleep(max(0.0, due - time.perf_counter()))
        image = images[number % len(images)].copy()  # as if it had just arrived
        started = time.perf_counter()
        prepared = estimator.preprocessor(image)
        prepared_at = time.perf_counter()
        presence.update(prepared)
        judged_at = time.perf_counter()
        estimator.estimate_prepared(prepared)
        ended = time.perf_counter()
        stages = (
            prepared_at - started,
            judged_at - prepared_at,
            estimator.times.infer,
            estimator.times.convert,
            ended - started,
        )
        for name, seconds in zip(STAGES, stages, strict=True):
            result[name].append(seconds)
        if opencv is not None:
            opencv(image)
            result["OpenCV"].append(time.perf_counter() - ended)
    return result


class OpenCvPreprocessing:
    """The same steps by OpenCV, for comparison."""

    def __init__(self, settings: PreprocessingSettings) -> None:
        self.settings = settings
        self.mask = np.zeros(settings.crop_shape, np.uint8)
        center = (settings.crop_shape[1] // 2, settings.crop_shape[0] // 2)
        cv2.circle(self.mask, center, settings.circle_mask_radius or 10**4, 255, thickness=-1)

    def __call__(self, image: NDArray) -> NDArray[np.float32]:
        settings = self.settings
        x0, y0, x1, y1 = settings.bbox
        smooth = cv2.medianBlur(image[y0:y1, x0:x1], settings.median)
        binary = cv2.adaptiveThreshold(
            smooth,
            255,
            cv2.ADAPTIVE_THRESH_MEAN_C,
            cv2.THRESH_BINARY,
            settings.threshold_block,
            settings.threshold_offset,
        )
        binary = cv2.bitwise_and(binary, self.mask)
        return as_input(cv2.resize(binary, (settings.size, settings.size), interpolation=cv2.INTER_AREA))


def simulated_images(count: int, seed: int = 0) -> NDArray[np.uint8]:
    """Images (count, 480, 640): ten without contact, then contacts of 0.5 to 5 mm at up to 23 degrees."""
    sensor, rng, images = TacTip(seed=seed), np.random.default_rng(seed), []
    for number in range(count):
        sensor.reset()
        tilts, depth = rng.uniform(-0.4, 0.4, 2), rng.uniform(0.5e-3, 5e-3)
        for height in (0.0205, 0.020 - depth) if number >= _CAPTURED else (0.0205,):
            sensor.advance(Plane(), se3.pose_from_euler([0, 0, height, np.pi + tilts[0], tilts[1], 0]))
        images.append(sensor.image().copy())
    return np.array(images)


def _percentiles(seconds: Sequence[float]) -> str:
    return " / ".join(f"{1e3 * np.percentile(seconds, q):.3f}" for q in (50, 99))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--model", type=Path, help="ONNX model (default: the shipped one)")
    parser.add_argument("--threads", type=int, default=1, help="threads of the network")
    parser.add_argument("--images", type=int, default=400)
    parser.add_argument("--rate", type=float, default=60.0, help="images a second")
    parser.add_argument("--opencv", action="store_true", help="add OpenCV's pre-processing")
    return parser.parse_args()


if __name__ == "__main__":
    main()
