"""What the simulated sensor and the simulated cell cost, and the accuracy that the sensor's dials buy.

    OMP_NUM_THREADS=1 python bench/simulation/speed.py [--seconds 10] [--skip-cell]

First: markers after presses and shears against steps of 0.025 mm solved to 1 nm, by the longest step and
the number of sweeps. Then times of single calls, medians. Last: the share of one core that two arms at 60
Hz take, which approach, press 3 mm deep and slide at 10 mm/s: processor time of this process over simulated
time.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Array, Table, parser, percentiles, taken

from tactile_geometry import se3
from tactile_scene.scene import Scene
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes import make_surface
from tactile_scene.simulated_sensors import ContactSettings, TacTipSettings
from tactile_sim.cell import Cell
from tactile_sim.collection import CollectionSettings, generate, press_then_shear
from tactile_sim.tactip import TacTip

DIALS = ((5e-4, 30), (2.5e-4, 30), (2.5e-4, 10), (2e-4, 30), (1e-4, 30), (1e-4, 300))  # m, sweeps
POSES = 12
SPEED = 0.010  # m/s along the surface


def markers(contact: ContactSettings, poses: Array) -> tuple[Array, float]:
    """Markers (N, 331, 3) after a press and shear each, and milliseconds for one."""
    sensor, found, started = TacTip(TacTipSettings(contact=contact)), [], time.process_time()
    for pose in poses:
        sensor.reset()
        press_then_shear(sensor, pose)
        found.append(sensor.marker_positions)
    return np.array(found), 1e3 * (time.process_time() - started) / len(poses)


def accuracy() -> None:
    """Speed against accuracy by the dials of the contact."""
    rng, limit = np.random.default_rng(0), np.array([4e-3, 4e-3, 2.5e-3, 0.3, 0.3, 0.08])
    poses = rng.uniform(-limit, limit, (POSES, 6))
    poses[:, 2] += 3.5e-3
    reference, _ = markers(ContactSettings(max_step=2.5e-5, max_sweeps=3000, tolerance=1e-9), poses)
    table = Table(("longest step", "sweeps", "ms", "RMS (um)", "largest (um)"), f"{POSES} poses, seed 0")
    for step, sweeps in DIALS:
        found, took = markers(ContactSettings(max_step=step, max_sweeps=sweeps), poses)
        error = 1e6 * np.linalg.norm(found - reference, axis=2)
        rms = float(np.sqrt(np.mean(error**2)))
        table.row(f"{1e3 * step:g} mm", f"{sweeps} sweeps", f"{took:.1f}", f"{rms:.1f}", f"{error.max():.0f}")


def calls() -> None:
    """Times of single calls."""
    started = time.perf_counter()
    sensor, plane = TacTip(), make_surface("plane")
    table = Table(("what", "ms"), "medians; start, once", timed=True)
    table.row("start", f"{1e3 * (time.perf_counter() - started):.0f}")
    down = se3.pose_from_euler([0.0, 0.0, sensor.settings.skin.radius, np.pi, 0.0, 0.0])
    for depth in (1.0, 3.0, 6.0):
        sensor.reset()
        for x, pressed in ((0.0, -1.0), (0.0, depth)):
            sensor.advance(plane, down @ se3.pose_from_euler([x, 0, pressed * 1e-3, 0, 0, 0]))
        step = taken(
            lambda k, depth=depth: sensor.advance(
                plane, down @ se3.pose_from_euler([1e-4 * (k + 1), 0, depth * 1e-3, 0, 0, 0])
            ),
            150,
        )
        table.row(f"step of 0.1 mm while sliding, {depth:g} mm deep", f"{np.median(step) / 1e3:.2f}")
    for name, call in (("image 640x480", sensor.image), ("truth", sensor.truth)):
        table.row(name, f"{np.median(taken(lambda _, call=call: call(), 200)) / 1e3:.2f}")
    started = time.perf_counter()
    count = sum(1 for _ in generate(CollectionSettings(), 0, range(100)))
    table.row("a sample of a collection, mean", f"{1e3 * (time.perf_counter() - started) / count:.1f}")


def two_of(scene: Scene) -> Scene:
    """The scene with a second arm like its first; both touch the same surface, not each other."""
    (arm,), (sensor,) = scene.arms.values(), scene.simulation.sensors.values()
    names = ("left", "right")
    simulation = dataclasses.replace(scene.simulation, sensors=dict.fromkeys(names, sensor))
    arms = {name: dataclasses.replace(arm, name=name) for name in names}
    return dataclasses.replace(scene, arms=arms, simulation=simulation)


def slide(cell: Cell, seconds: float) -> list[float]:
    """Run with a perfect controller on the truth; milliseconds of all exposures."""
    twists, durations = {arm: np.zeros(6) for arm in cell.arms}, []
    for _ in range(round(seconds * cell.scene.simulation.rate)):
        cell.step()
        for arm in cell.arms:
            if cell.exposure_due(arm):
                started = time.perf_counter()
                truth = cell.expose(arm).truth
                durations.append(1e3 * (time.perf_counter() - started))
                twists[arm] = follow(truth.depth, truth.T_fs)
            cell.command(arm, cell.stamp_ns, twists[arm])
    return durations


def follow(depth: float, T_fs: Array) -> Array:
    """Approach at up to 20 mm/s, then keep 3 mm and the normal, and slide along y."""
    twist, inward = np.zeros(6), T_fs[2, :3]  # z of {f} in {s}
    twist[:3] = min(0.020, 5.0 * (0.003 - depth)) * inward
    if depth > 0.0025:
        twist[1] += SPEED
        twist[3:] = 4.0 * np.cross([0.0, 0.0, 1.0], inward)
    return twist


def cells(seconds: float) -> None:
    """Share of a core by scene and fidelity."""
    heads = ("two arms on", "sensors", "share of a core", "exposure p50, ms", "p99, ms")
    table = Table(heads, f"one run of {seconds:g} s each", timed=True)
    for name in ("plane", "ramp", "dome"):
        for fidelity in ("ideal", "image"):
            cell = Cell(two_of(load_scene(name)).with_fidelity(fidelity), seed=1)
            slide(cell, 1.2)  # approach, not counted
            cpu = time.process_time()
            durations = slide(cell, seconds)
            share = (time.process_time() - cpu) / seconds
            table.row(name, fidelity, f"{share:.3f}", *(f"{value:.2f}" for value in percentiles(durations)))


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--seconds", type=float, default=10.0, help="simulated time of each run of a cell")
    arguments.add_argument("--skip-cell", action="store_true")
    given = arguments.parse_args()
    accuracy()
    calls()
    if not given.skip_cell:
        cells(given.seconds)


if __name__ == "__main__":
    main()
