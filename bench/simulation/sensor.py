"""Speed and shear saturation of the simulated sensor on one core.

OMP_NUM_THREADS=1 python bench/simulator.py
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from tactile_drivers.shapes import make_surface
from tactile_drivers.shapes.surface import Surface
from tactile_drivers.sim.collection import CollectionSettings, generate, press_then_shear
from tactile_drivers.sim.settings import ContactSettings, TacTipSettings
from tactile_drivers.sim.skin import load_skin
from tactile_drivers.sim.tactip import TacTip
from tactile_geometry import se3

DEPTHS = (0.5, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0)  # mm
STEP = 0.1  # mm a step
ACCURACY_POSES = 12


def milliseconds(work: Callable[[], object], times: int) -> float:
    """Median duration of `work`."""
    durations = []
    for _ in range(times):
        start = time.perf_counter()
        work()
        durations.append(time.perf_counter() - start)
    return 1e3 * float(np.median(durations))


def pose(sensor: TacTip, x: float, depth: float) -> np.ndarray:
    facing_down = se3.pose_from_euler([0.0, 0.0, sensor.settings.skin.radius, np.pi, 0.0, 0.0])
    return facing_down @ se3.pose_from_euler([x * 1e-3, 0, depth * 1e-3, 0, 0, 0])


def by_depth(sensor: TacTip, plane: Surface) -> None:
    print("depth mm  ms/step  nodes  normal force N  saturated shear mm (friction 0.9)")
    for depth in DEPTHS:
        sensor.reset()
        sensor.advance(plane, pose(sensor, 0, -1))
        sensor.advance(plane, pose(sensor, 0, depth))
        force = sensor.truth().normal_force
        shifts = iter(np.arange(STEP, 20, STEP))
        step = milliseconds(lambda: sensor.advance(plane, pose(sensor, next(shifts), depth)), 150)  # noqa: B023
        truth = sensor.truth()
        slipping = "" if truth.slip_fraction > 0.95 else f" (slip fraction {truth.slip_fraction:.2f})"
        shear = truth.T_fs[0, 3] * 1e3
        print(f"{depth:6.1f} {step:9.2f} {truth.contact_nodes:6d} {force:12.2f} {shear:14.2f}{slipping}")


def queries(sensor: TacTip) -> None:
    nodes = load_skin(sensor.settings.skin).nodes
    for kind, center in (("plane", 0.015), ("dome", 0.09), ("box", 0.0435), ("sphere", 0.05)):
        shape, there = make_surface(kind), nodes + np.array([0.0, 0.0, center])
        duration = milliseconds(lambda: shape.query(there), 500)  # noqa: B023
        print(f"query of {len(nodes)} nodes near a {kind}: {duration:.3f} ms")


def accuracy() -> None:
    """Markers against a reference with ten times smaller steps, solved to 1 nm."""
    rng = np.random.default_rng(0)
    limit = np.array([4e-3, 4e-3, 2.5e-3, 0.3, 0.3, 0.08])
    poses = rng.uniform(-limit, limit, (ACCURACY_POSES, 6))
    poses[:, 2] += 3.5e-3
    reference = _markers(ContactSettings(max_step=2.5e-5, max_sweeps=3000, tolerance=1e-9), poses)[0]
    print("max step mm  max sweeps  ms/pose  marker error um: rms  max")
    for step, sweeps in ((5e-4, 30), (2.5e-4, 30), (2.5e-4, 10), (2e-4, 30), (1e-4, 30), (1e-4, 300)):
        markers, duration = _markers(ContactSettings(max_step=step, max_sweeps=sweeps), poses)
        error = 1e6 * np.linalg.norm(markers - reference, axis=2)
        rms = np.sqrt(np.mean(error**2))
        print(f"{step * 1e3:8.2f} {sweeps:11d} {duration:10.1f} {rms:17.1f} {error.max():6.1f}")


def _markers(contact: ContactSettings, poses: np.ndarray) -> tuple[np.ndarray, float]:
    sensor = TacTip(TacTipSettings(contact=contact))
    out = []
    start = time.perf_counter()
    for pose6 in poses:
        sensor.reset()
        press_then_shear(sensor, pose6)
        out.append(sensor.marker_positions)
    return np.array(out), 1e3 * (time.perf_counter() - start) / len(poses)


def main() -> None:
    start = time.perf_counter()
    sensor = TacTip()
    print(f"start: {time.perf_counter() - start:.2f} s")
    plane = make_surface("plane", {})
    by_depth(sensor, plane)
    queries(sensor)
    print(f"image 640x480: {milliseconds(sensor.image, 200):.2f} ms")
    print(f"truth: {milliseconds(sensor.truth, 200):.2f} ms")
    start = time.perf_counter()
    count = sum(1 for _ in generate(CollectionSettings(), 0, range(100)))
    print(f"collection: {1e3 * (time.perf_counter() - start) / count:.1f} ms a sample on one process")
    accuracy()


if __name__ == "__main__":
    main()
