"""Pushed objects: how far the ellipsoid is from Coulomb's limit surface, time a step, and what topples.

OMP_NUM_THREADS=1 python bench/pushed_objects.py [--way FILE] [--topple] [--trials N] [--objects NAME ...]

`--way` writes pushes for bench/pushed_objects_mujoco.py; `--topple` runs the tall objects with the paper's
controllers (ideal sensors) and counts who stands.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base.yaml_file import Section
from tactile_bringup.experiment import Common, Trial, table_of, trial_row
from tactile_drivers.scene import Scene, load_scene
from tactile_drivers.sim.cell import Cell
from tactile_drivers.sim.limit_surface import Foot
from tactile_drivers.sim.pushed import Pushed, PushedSettings
from tactile_drivers.sim.pushing_scene import pushing_scene, read_profiles

SPEED, HEIGHT = 0.010, 0.045  # m/s; m above the floor
SKIN = 700.0  # N/m, of the linear skin that MuJoCo's springs have, too
# object, and how far (m) it stands to the side
PUSHES = (("blue_square", 0.0), ("blue_square", 0.01), ("blue_circle", 0.0), ("blue_circle", 0.008))


def limit_surface() -> None:
    """Load of evenly and unevenly pressed feet that turn about points all around, over the ellipsoid."""
    print("foot, pressure: load over the ellipsoid, least and largest")
    rng = np.random.default_rng(0)
    angle = 2 * np.pi * np.arange(60) / 60
    shapes = {
        "square": np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]),
        "disc": np.column_stack([np.cos(angle), np.sin(angle)]),
        "hexagon": np.column_stack([np.cos(angle[::10]), np.sin(angle[::10])]),
    }
    for name, corners in shapes.items():
        foot = Foot.around(0.04 * corners)
        points = np.array([p for p in rng.uniform(-0.04, 0.04, (20000, 2)) if foot.inside(p) > 0])
        for ahead in (0.0, 0.5, 1.0):  # of the way to the edge of the core
            slope = np.linalg.solve(foot.spread, [0.0, 1.0])
            press = 1.0 + ahead * (points @ slope) / (foot.corners @ slope).max()
            press /= press.sum()
            used = _used(points, press, foot)
            where = f"centre {100 * ahead:3.0f} % of the way to the core's edge"
            print(f"  {name:8} {where}: {used.min():.3f} {used.max():.3f}")


def _used(points: np.ndarray, press: np.ndarray, foot: Foot) -> np.ndarray:
    center, used = press @ points, []
    for distance in 0.08 * np.geomspace(0.02, 20, 20):
        for direction in np.linspace(0, 2 * np.pi, 12, endpoint=False):
            arms = points - center - distance * np.array([np.cos(direction), np.sin(direction)])
            along = np.column_stack([-arms[:, 1], arms[:, 0]]) / np.hypot(*arms.T)[:, None]
            off = points - center
            torque = press @ (off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0])
            used.append(np.hypot(np.linalg.norm(press @ along), torque / foot.arm))
    return np.array(used)


def changed(scene: Scene, **settings: Any) -> Scene:
    """The scene with some of the pushed body's settings in place."""
    body = scene.bodies["pushed"]
    own = body.motion_settings
    section = Section(own.path, own.line, {**own.values, **settings}, {})
    return replace(scene, bodies={"pushed": replace(body, motion_settings=section)})


class Timed:
    """A motion whose steps are timed."""

    def __init__(self, motion: Pushed) -> None:
        self.seconds: list[float] = []
        self.step_of, motion.step = motion.step, self.step  # type: ignore[assignment, method-assign]

    def step(self, *args: Any) -> np.ndarray:
        begun = time.thread_time()
        T = self.step_of(*args)
        self.seconds.append(time.thread_time() - begun)
        return T


def straight(scene: Scene, velocity: tuple[float, float], seconds: float) -> dict[str, Any]:
    """Every first arm goes straight with a velocity (x, y) in the world; others stand still."""
    cell = Cell(scene, 0)
    motion = cell.motion("pushed")
    assert isinstance(motion, Pushed)
    timed, arm = Timed(motion), cell.arms[0]
    way: dict[str, list[Any]] = {"time": [], "sensor": [], "object": []}
    while cell.stamp_ns < seconds * 1e9:
        T, sensor = cell.T_world_body("pushed"), cell.T_base_sensor(arm)[:3, 3]
        way["time"].append(1e-9 * cell.stamp_ns)
        way["sensor"].append(sensor[:2].tolist())
        way["object"].append([*T[:2, 3].tolist(), float(np.arctan2(T[1, 0], T[0, 0]))])
        cell.command(arm, cell.stamp_ns, [0, -velocity[0], velocity[1], 0, 0, 0])
        cell.step()
        for name in cell.arms:
            if cell.exposure_due(name):
                cell.expose(name)
    return {**way, "step_us": 1e6 * float(np.percentile(timed.seconds[len(timed.seconds) // 2 :], 10))}


def step_time() -> None:
    pushed = straight(load_scene("pushing").with_fidelity("ideal"), (0.0, SPEED), 10.0)
    print(
        f"time of a step of the body while one tip slides it (us, the fastest tenth): {pushed['step_us']:.0f}"
    )


def ways(path: Path) -> None:
    """The same pushes for MuJoCo, with a linear skin."""
    quiet = {"sigma_position": (0.0, 0.0, 0.0), "sigma_rotation": (0.0, 0.0, 0.0)}
    skin = {"skin_force": SKIN * 6e-3, "skin_exponent": 1.0, "skin_shear": SKIN, "skin_shear_exponent": 0.0}
    cases = []
    for name, aside in PUSHES:
        for velocity in ((0.0, SPEED), (-0.5 * SPEED, SPEED)):
            scene = changed(
                pushing_scene(load_scene("pushing").with_fidelity("ideal", **quiet), name, "mdf"), **skin
            )
            body = scene.bodies["pushed"]
            T = body.T_parent_body.copy()
            T[0, 3] += aside
            T[1, 3] += 0.002 if "circle" not in name else 0.0
            scene = replace(scene, bodies={"pushed": replace(body, T_parent_body=T)})
            values = body.motion_settings.checked(PushedSettings, body.motion_settings.values)
            half = body.make().grid().reshape(-1, 3).max(axis=0).tolist()
            cases.append({
                "name": f"{name} {1e3 * aside:+.0f} mm, {'straight' if velocity[0] == 0 else 'oblique'}",
                "shape": body.shape, "half": half, "mass": values.mass, "friction": values.friction,
                "friction_tip": values.friction_tip, "height": HEIGHT, "along": SKIN, "across": SKIN,
                "damping": 2 * np.sqrt(SKIN * 0.01), **straight(scene, velocity, 4.0),
            })  # fmt: skip
    path.write_text(json.dumps(cases))
    print(f"{path}: {len(cases)} pushes")


def catching() -> None:
    """The least friction of floor and edge with which objects catch and topple, pushed by one tip."""
    print("object: friction of the floor above which the edge bears load, of the edge above which it topples")
    scene = load_scene("pushing")
    for name in read_profiles().objects:
        motion = Cell(pushing_scene(scene, name, "mdf")).motion("pushed")
        assert isinstance(motion, Pushed)
        ahead = np.linspace(0.0, 0.06, 6001)
        core = next(y for y in ahead if motion.foot.edge_share([0.0, y]) > 0)
        edge = next(y for y in ahead if motion.foot.inside([0.0, y]) < 0)
        print(f"  {name:20} {core / HEIGHT:.2f} {edge / HEIGHT:.2f}")


def topple(trials: int, objects: list[str]) -> None:
    """Tall objects on MDF with the paper's controllers: how many of `trials` tilted by over 5 degrees."""
    common = Common("tall", fidelity="ideal")
    print("object: of", trials, "trials, toppled with both arms; with the leader alone")
    for name, _ in table_of("tall").rows(objects):
        counts = []
        for arm in ("", "leader"):
            rows = [
                trial_row(Trial(replace(common, arm=arm), name, "mdf", number)) for number in range(trials)
            ]
            counts.append(sum(bool(row["body_tilt_max_deg"] > 5.0) for row in rows))
        print(f"  {name:20} {counts[0]:3d} {counts[1]:3d}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--way", type=Path)
    parser.add_argument("--topple", action="store_true")
    parser.add_argument("--trials", type=int, default=1)
    parser.add_argument("--objects", nargs="*", default=[])
    options = parser.parse_args()
    if options.way:
        ways(options.way)
    elif options.topple:
        topple(options.trials, options.objects)
    else:
        limit_surface()
        catching()
        step_time()


if __name__ == "__main__":
    main()
