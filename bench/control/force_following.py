r"""Surface following at a reference force, in the loop without ROS: the true normal force (simulated).

    tactile data generate out/forces --train 6500 --val 500 --set curvature=[-5.0,16.0]
    tactile train out/forces --out out/force_model --model surface_force \
        --config config/perception/gdn_symmetry.yaml --set augmentation.symmetry=1
    python bench/control/force_following.py out/force_model

The built-in tip, of which forces scale with its gel's modulus alone (8 kPa). RMS and largest deviations are
from a second after the work began; "depth" is a run at the depth that gives that force on a plane.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task, task_path
from tactile_records.runs.log import RunLog
from tactile_sim.frame import Frame

FORCES = (0.3, 0.6)  # N
DEPTHS = {0.3: 0.0022, 0.6: 0.0033}  # m, of the built-in tip on a plane
SCENES = ("ramp", "dome")


class TrueForces(RunLog):
    """Keeps what the simulated skin says of the normal force."""

    def __init__(self, record) -> None:
        super().__init__(record)
        self.rows: list[tuple[int, float]] = []

    def exposure(self, frame: Frame) -> None:
        super().exposure(frame)
        self.rows.append((frame.stamp_ns, frame.truth.normal_force))


def forces(scene: str, model: Path, seed: int, changes: list[str]) -> tuple[NDArray, NDArray, str]:
    """True normal forces (N) and depths (m) at work, and why the run failed, if it did."""
    logs: list[TrueForces] = []

    def log(record) -> TrueForces:
        logs.append(TrueForces(record))
        return logs[-1]

    task = load_task(task_path("surface_following"), scene, changes=changes)
    options = OfflineOptions(fidelity="image", model=model, seed=seed, time_limit=900.0)
    (record,) = run_arms_offline(scene, task, options, log=log).values()
    stamps, normal = (np.array(column) for column in zip(*logs[0].rows, strict=True))
    work = record.working(stamps)
    if work.any():
        work &= stamps >= stamps[work][0] + SECOND_NS
    truth = record.truth
    depth = truth.T_fs[np.isin(truth.stamp_ns, stamps[work]), 2, 3]
    return normal[work], depth, "" if record.result["succeeded"] else record.result["reason"]


def main() -> None:
    arguments = parser(__doc__)
    arguments.add_argument("model", type=Path, help="that tells forces: a run folder or an ONNX file")
    arguments.add_argument("--seeds", type=int, default=2)
    arguments = arguments.parse_args()
    table = Table(
        ("scene, reference", "RMS (N)", "largest (N)", "mean (N)", "depths (mm)", "failed"),
        f"over seeds 0 to {arguments.seeds - 1}",
    )
    for scene in SCENES:
        for force in FORCES:
            depth = f"follower.servoing.reference=[0, 0, {DEPTHS[force]}, 0, 0, 0]"
            for name, changes in (("force", [f"follower.force.normal={force}"]), ("depth", [depth])):
                found = [forces(scene, arguments.model, seed, changes) for seed in range(arguments.seeds)]
                off = np.concatenate([normal for normal, _, _ in found]) - force
                deep = 1e3 * np.concatenate([depths for _, depths, _ in found])
                failed = {why for _, _, why in found if why}
                table.row(
                    f"{scene}, {force:g} N by {name}", f"{np.sqrt(np.mean(off**2)):.3f}",
                    f"{np.abs(off).max():.3f}", f"{off.mean():+.3f}",
                    f"{deep.min():.1f} to {deep.max():.1f}", "; ".join(sorted(failed)) or "-",
                )  # fmt: skip


if __name__ == "__main__":
    main()
