"""What `tactile cell` finds of a simulated cell whose scene is wrong by known amounts, and how sure it is.

    python bench/cell_calibration.py --seeds 3

Images are simulated; every run is that of the command with --simulate. Errors are found less true.
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

from tactile_bringup.cell_touching import simulated
from tactile_drivers.scene import Scene, load_scene
from tactile_geometry import se3
from tactile_records.calibrating import mounting, time_offset, tip
from tactile_records.calibrating.touches import touches_of

SAID = (0.0, 0.0, 0.065)  # m, as the scene of the table has it
TIME = (0.0, 0.010, 0.025)  # s, delay of the camera
TIP = ((0.0,) * 6, (1.4, -1.4, 1.5, 3.0, 0.0, 0.0), (-2.0, 0.5, -1.0, 0.0, 2.0, 5.0))  # mm, degrees
MOUNTING = ((0.0,) * 6, (0.0, 0.0, 0.0, 0.0, 0.0, 5.0), (0.0, 0.0, 0.0, 3.0, -2.0, 5.0))


def scene(delay: float = 0.0, off: tuple[float, ...] = (0.0,) * 6) -> Scene:
    """The table's, with a camera that is late (s) and a sensor that stands off (mm, degrees)."""
    table = load_scene("plane")
    where = (*(np.array(SAID) + np.array(off[:3]) * 1e-3), *np.radians(off[3:]))
    sensor = dataclasses.replace(table.simulation.sensors["arm"], delay=delay, in_tool=where)
    return dataclasses.replace(
        table, simulation=dataclasses.replace(table.simulation, sensors={"arm": sensor})
    )


def text(values: np.ndarray) -> str:
    """Numbers in a cell of a table."""
    return ", ".join(f"{value:.2f}" for value in np.atleast_1d(values))


def row(what: str, truth: str, seed: int, error: np.ndarray, sigma: np.ndarray, residual: str) -> None:
    """One line of the table."""
    print(f"| {what} | {truth} | {seed} | {text(error)} | {text(sigma)} | {residual} |", flush=True)


def main() -> None:
    """All cases, for each seed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    print("| command | true | seed | error | sigma | residual |\n| --- | --- | --- | --- | --- | --- |")
    for delay in TIME:
        for seed in seeds:
            found = time_offset.of_record(simulated(scene(delay), "arm", "time", seed))
            error, sigma = 1e3 * np.array([found.seconds + delay, found.sigma])
            row("time", f"{0.0 - 1e3 * delay:g} ms", seed, error, sigma, f"{1e3 * found.residual:.3f} mm")
    for off in TIP:
        R = se3.pose_from_euler([0.0, 0.0, 0.0, *np.radians(off[3:])])[:3, :3]
        for seed in seeds:
            touches = touches_of(simulated(scene(off=off), "arm", "tip", seed))
            place = tip.estimated(np.array([touch.T_base_sensor for touch in touches]))
            error = 1e3 * place.offset - np.array(off[:3])
            turned = np.degrees(Rotation.from_matrix(R).magnitude())
            truth = f"{off[0]:g}, {off[1]:g}, {off[2]:g} mm, tilted {turned:.1f} deg"
            row("tip", truth, seed, error, 1e3 * place.sigma, f"{1e3 * place.residual:.3f} mm")
    for off in MOUNTING:
        R = Rotation.from_euler("xyz", off[3:], degrees=True)
        for seed in seeds:
            turned = mounting.estimated(
                mounting.contacts_of(simulated(scene(off=off), "arm", "mounting", seed))
            )
            error = np.degrees(turned.rotation - R.as_rotvec())
            residual = np.degrees(np.sqrt(np.mean(turned.normal_residuals**2)))
            truth = f"{text(R.as_rotvec(degrees=True))} deg"
            row("mounting", truth, seed, error, np.degrees(turned.sigma), f"{residual:.2f} deg")


if __name__ == "__main__":
    main()
