"""What is left of a badly mounted sensor once `tactile cell tip` and `mounting` have measured it, in pushes.

    python bench/control/calibrated_pushes.py [--seeds 3] [--trials 50]

A sensor stands turned and shifted in its tool, which the scene does not know. It touches a table, in
simulated images, and what both commands find is written into the scene, as with --write. Then the blue square
is pushed on MDF by our steering with the sensor as it stands, and with what the scene is still wrong by
(fidelity plane).
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_base.config_paths import config_path
from tactile_bringup import cell_touching
from tactile_bringup.experiments.pushing import PLANE, Common, Trial
from tactile_bringup.experiments.pushing_plane import batches, plane_rows
from tactile_bringup.scene_values import write_into
from tactile_geometry import se3
from tactile_records.calibrating.results import RESULTS, pose_values
from tactile_scene.scene_file import load_scene

MOUNTINGS = ((0.0, 0.0), (3.0, 0.0), (0.0, 1.0), (3.0, 1.0))  # to the left: degrees, mm
STEERINGS = ("tuned", "offset")


def left_over(angle: float, offset: float, seed: int) -> tuple[float, float]:
    """What calibrating leaves of a mounting (deg, mm), leftwards as `contact_angle` and `contact_offset`."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        text = config_path("scenes/plane.yaml").read_text()
        (said,) = load_scene("plane").arms.values()
        T = said.sensor.T_tool_sensor @ se3.pose_from_euler([0, 1e-3 * offset, 0, -np.radians(angle), 0, 0])
        true = pose_values(T)
        path.write_text(text + f"simulation: {{sensors: {{{said.name}: {{in_tool: {true}}}}}}}\n")
        for what in ("tip", "mounting"):
            scene = load_scene(path)
            record = cell_touching.simulated(scene, said.name, what, seed)
            if not record.result["succeeded"]:
                raise SystemExit(f"{what}: {record.result['reason']}")
            found = RESULTS[what](record, scene.arms[said.name].sensor)
            write_into(path, said.name, dict(found.sensor))
        now = load_scene(path).arms[said.name].sensor.T_tool_sensor
    left = se3.euler_from_pose(se3.inverse(now) @ T)
    return -float(np.degrees(left[3])), 1e3 * float(left[1])


def errors(mountings: list[tuple[float, float]], controller: str, trials: int) -> np.ndarray:
    """Sizes of the final errors (mm) of pushes with each of some mountings, those that fail among them."""
    common = Common("single", controller, PLANE)
    pushes = [
        Trial(common, "blue_square", "mdf", number, (("contact_angle", angle), ("contact_offset", offset)))
        for angle, offset in mountings
        for number in range(trials)
    ]
    return np.array([row["error_abs_mm"] for batch in batches(pushes) for row in plane_rows(batch)])


def cells(mountings: list[tuple[float, float]], trials: int) -> Iterator[str]:
    """Mean and largest error by each steering."""
    for controller in STEERINGS:
        sizes = errors(mountings, controller, trials)
        yield f"{sizes.mean():.2f} ({sizes.max():.2f})"


def main() -> None:
    """A row a mounting."""
    arguments = parser(__doc__)
    arguments.add_argument("--seeds", type=int, default=3, help="calibrations of each (3)")
    arguments.add_argument("--trials", type=int, default=50, help="pushes with each (50)")
    given = arguments.parse_args()
    heads = [f"{when}, `{name}` (mm)" for when in ("before", "after") for name in STEERINGS]
    table = Table(
        ["mounted (deg, mm)", "largest left (deg, mm)", *heads], "mean size of the error, largest in brackets"
    )
    for angle, offset in MOUNTINGS:
        left = [left_over(angle, offset, seed) for seed in range(given.seeds)]
        most = np.abs(left).max(axis=0)
        before = cells([(angle, offset)], given.trials)
        table.row(
            f"{angle:g}, {offset:g}", f"{most[0]:.2f}, {most[1]:.2f}", *before, *cells(left, given.trials)
        )


if __name__ == "__main__":
    main()
