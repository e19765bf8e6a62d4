"""How much of a core the simulated cell takes: two sensors at 60 Hz, by scene and fidelity.

    python bench/cell.py [--seconds 10]

Each arm approaches, presses 3 mm deep and slides at 10 mm/s. CPU share is processor time of this process over
simulated time: 1.0 would be one core fully used in real time.
"""

from __future__ import annotations

import argparse
import dataclasses
import time

import numpy as np

from tactile_drivers.scene import Scene, load_scene
from tactile_drivers.sim.cell import Cell
from tactile_geometry import se3

SPEED = 0.010  # m/s along the surface


def two_of(scene: Scene) -> Scene:
    """The scene with a second arm like its first; both touch the same surface, not each other."""
    (arm,), (sensor,) = scene.arms.values(), scene.simulation.sensors.values()
    names = ("left", "right")
    simulation = dataclasses.replace(scene.simulation, sensors=dict.fromkeys(names, sensor))
    arms = {name: dataclasses.replace(arm, name=name) for name in names}
    return dataclasses.replace(scene, arms=arms, simulation=simulation)


def slide(cell: Cell, seconds: float) -> list[float]:
    """Run with a perfect controller on the truth; the durations (s) of all exposures."""
    twists = {arm: np.zeros(6) for arm in cell.arms}
    durations = []
    for _ in range(round(seconds * cell.scene.simulation.rate)):
        cell.step()
        for arm in cell.arms:
            if cell.exposure_due(arm):
                start = time.perf_counter()
                frame = cell.expose(arm)
                durations.append(time.perf_counter() - start)
                twists[arm] = follow(frame.truth.depth, frame.truth.T_fs)
            cell.command(arm, cell.stamp_ns, twists[arm])
    return durations


def follow(depth: float, T_fs: np.ndarray) -> np.ndarray:
    """Approach at up to 20 mm/s, then keep 3 mm and the normal, and slide along y."""
    twist = np.zeros(6)
    inward = T_fs[2, :3]  # z of {f} in {s}
    twist[:3] = min(0.020, 5.0 * (0.003 - depth)) * inward
    if depth > 0.0025:
        twist[1] += SPEED
        twist[3:] = 4.0 * np.cross([0.0, 0.0, 1.0], inward)
    return twist


def share(scene: Scene, seconds: float) -> tuple[float, np.ndarray, float]:
    """CPU share, exposure durations, and the set-up time (s)."""
    start = time.perf_counter()
    cell = Cell(scene, seed=1)
    setup = time.perf_counter() - start
    slide(cell, 1.2)  # approach, not counted
    cpu = time.process_time()
    durations = slide(cell, seconds)
    return (time.process_time() - cpu) / seconds, np.array(durations), setup


def step_cost(repeat: int = 2000) -> dict[str, float]:
    """Microseconds of the parts of a step that do not depend on the sensor."""
    cell = Cell(load_scene("ramp").with_fidelity("ideal"))
    parts = {}
    start = time.perf_counter()
    for _ in range(repeat):
        cell.command("arm", cell.stamp_ns, [0.0, 0.001, 0.0, 0.0, 0.0, 0.0])
        cell.step()
    parts["command and step, one arm"] = (time.perf_counter() - start) / repeat * 1e6
    xi = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    start = time.perf_counter()
    for _ in range(repeat):
        se3.exp(xi)
    parts["of which se3.exp"] = (time.perf_counter() - start) / repeat * 1e6
    return parts


def main() -> None:
    """Print one line a scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated time of each line")
    args = parser.parse_args()
    print("two arms, 120 Hz, cameras at 60 Hz")
    print(f"{'scene':8}{'fidelity':10}{'CPU share':>10}{'expose p50':>12}{'p99':>8}{'set-up':>9}")
    for name in ("plane", "ramp", "dome"):
        for fidelity in ("ideal", "image"):
            cpu, durations, setup = share(two_of(load_scene(name)).with_fidelity(fidelity), args.seconds)
            p50, p99 = np.quantile(durations, [0.5, 0.99]) * 1e3
            print(f"{name:8}{fidelity:10}{cpu:10.3f}{p50:9.2f} ms{p99:5.2f} ms{setup:7.2f} s")
    for part, microseconds in step_cost().items():
        print(f"{part}: {microseconds:.1f} us")


if __name__ == "__main__":
    main()
