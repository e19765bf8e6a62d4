"""What the look at each image costs, and a whole percept of a simulated image: p50 of processor time.

python bench/image_check.py [--images 300]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from tactile_drivers.shapes.plane import Plane
from tactile_drivers.sim.tactip import TacTip
from tactile_geometry import se3
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.image_check import SIDE, ImageCheck, ImageCheckSettings
from tactile_perception.estimating.perceive import Perceiver
from tactile_perception.estimating.presence import ContactPresence


def milliseconds(action: Callable[[], Any]) -> float:
    started = time.thread_time()  # of a core: the machine may have other work
    action()
    return 1e3 * (time.thread_time() - started)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--images", type=int, default=300)
    args = parser.parse_args()
    sensor, check = TacTip(seed=1), ImageCheck(ImageCheckSettings(repeats=True))
    perceive = Perceiver(Estimator(), ContactPresence(), check)
    for _ in range(10):
        perceive(sensor.image())
    for depth in np.arange(-0.5, 3.0, 0.1):
        sensor.advance(Plane(), se3.pose_from_euler([0.0, 0.0, 0.020 - depth * 1e-3, np.pi, 0.0, 0.0]))
        perceive(sensor.image())
    images = [sensor.image() for _ in range(args.images)]
    prepare, times = perceive.estimator.preprocessor, []
    for image in images:
        prepare(image)
        view = prepare.view(SIDE)
        camera = milliseconds(lambda image=image: check.exposure(image))
        looked = milliseconds(lambda view=view: check.look(view, True))
        times.append((camera, looked))
    rest = [milliseconds(lambda image=image: perceive(image)) for image in images[1:] + images[:1]]
    camera, looked = np.median(times, axis=0)
    print(f"p50 of {len(images)} images: camera's image {camera:.3f} ms, after the threshold {looked:.3f} ms")
    print(f"together {camera + looked:.3f} ms of a whole percept in contact, {np.median(rest):.3f} ms")


if __name__ == "__main__":
    main()
