"""What each stage of an estimate costs on one core, image after image and with the pauses of a camera.

    python bench/perception/stages.py [--model FILE] [--images 400] [--rate 60]

A node at 60 Hz sleeps 14 of 16 ms and finds its caches taken by others and its core slowed down: the second
pair of columns is what it pays. Images are simulated. "look" is the check of the image itself, which a
percept adds to an estimate.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser, percentiles

from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.image_check import SIDE, ImageCheck, ImageCheckSettings
from tactile_perception.estimating.presence import ContactPresence, PresenceSettings
from tactile_scene.shapes.plane import Plane
from tactile_sim.tactip import TacTip

_CAPTURED = 10


def stage_times(
    estimator: Estimator, images: NDArray[np.uint8], count: int, rate: float
) -> dict[str, list[float]]:
    """Milliseconds of each stage of the estimator node's work on `count` images.

    Parameters
    ----------
    images : (N, 480, 640), the first `_CAPTURED` without contact
    rate : images a second; 0: one after another
    """
    presence = ContactPresence(PresenceSettings(reference_frames=_CAPTURED))
    check, result = ImageCheck(ImageCheckSettings(repeats=True)), {}
    for image in images[:_CAPTURED]:
        presence.update(estimator.preprocessor(image))
    due = time.perf_counter()
    for number in range(count):
        due += 1.0 / rate if rate else 0.0
        time.sleep(max(0.0, due - time.perf_counter()))
        image = images[number % len(images)].copy()  # as if it had just arrived
        stamps = [time.perf_counter()]
        prepared = estimator.preprocessor(image)
        stamps.append(time.perf_counter())
        presence.update(prepared)
        stamps.append(time.perf_counter())
        estimator.estimate_prepared(prepared)
        stamps.append(time.perf_counter())
        view = estimator.preprocessor.view(SIDE)
        check.exposure(image)
        check.look(view, True)
        stamps.append(time.perf_counter())
        one, two, _, look = np.diff(stamps)
        found = {"pre-processing": one, "presence": two, "network": estimator.times.infer}
        found |= {"conversion": estimator.times.convert, "all": stamps[3] - stamps[0], "look": look}
        for name, seconds in found.items():
            result.setdefault(name, []).append(1e3 * seconds)
    return result


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


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--model", type=Path, help="ONNX model (default: the shipped one)")
    arguments.add_argument("--threads", type=int, default=1, help="threads of the network")
    arguments.add_argument("--images", type=int, default=400)
    arguments.add_argument("--rate", type=float, default=60.0, help="images a second")
    given = arguments.parse_args()
    estimator, images = Estimator(given.model or "", given.threads), simulated_images(24)
    measured = [stage_times(estimator, images, given.images, rate) for rate in (0.0, given.rate)]
    heads = (estimator.path.name, "p50, ms", "p99, ms", f"at {given.rate:g} Hz: p50, ms", "p99, ms")
    table = Table(heads, f"{given.images} images, {given.threads} thread(s)", timed=True)
    for name in measured[0]:
        table.row(name, *(f"{ms:.3f}" for times in measured for ms in percentiles(times[name])))


if __name__ == "__main__":
    main()
