"""How far the depth by an image's brightness is off: on labelled folders, and from the network's in runs.

    python bench/perception/plain_depth.py [FOLDER ...] [--scenes plane tracking_ball ...] [--seed 0]

Each folder is split by halves: fitted to one, tried on the other. Runs are those of the packaged tasks with
simulated images and the shipped model; what is told of them is what decides about false alarms.
"""

from __future__ import annotations

import sys
from pathlib import Path
from unittest import mock

import numpy as np
from numpy.typing import NDArray

sys.path.extend(str(Path(__file__).resolve().parents[1] / name) for name in ("", "graph"))

from honest_runs import TASKS
from shared import Table, parser

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_perception.datasets.dataset import read_dataset
from tactile_perception.estimating.labels import depths
from tactile_perception.estimating.perceive import DepthAgreement, Percept, depth_of
from tactile_perception.estimating.plain_depth import PlainDepth
from tactile_perception.estimating.preprocessing import as_input

_COLUMNS = ["data, or scene", "images", "RMS (mm)", "mean (mm)", "largest (mm)"]


def errors_on(folder: Path) -> NDArray[np.float64]:
    """Errors (m) on every other contact of a folder, of a fit to the rest."""
    data = read_dataset(folder)
    true = depths(data.labels)
    plain = PlainDepth.fit(data.images[::2], true[::2])
    return np.array([plain(as_input(image)) for image in data.images[1::2]]) - true[1::2]


def differences_in(scene: str, seed: int) -> NDArray[np.float64]:
    """From the network's depth (m), in each image of a run in contact."""
    found: dict[int, tuple[object, float]] = {}  # by the estimate: each is looked at twice

    def noted(agreement: DepthAgreement, percept: Percept, limit: float) -> Percept:
        if percept.estimate is not None:
            estimate = percept.estimate
            found[id(estimate)] = estimate, percept.plain_depth - depth_of(estimate)
        return percept

    with mock.patch.object(DepthAgreement, "__call__", noted):
        records = run_arms_offline(scene, TASKS[scene], OfflineOptions(fidelity="image", seed=seed))
    if reason := "; ".join({record.result["reason"] for record in records.values()} - {""}):
        print(f"{scene}: {reason}")
    return np.array([difference for _, difference in found.values()])


def main() -> None:
    """See the module's text."""
    given = parser(__doc__ or "")
    given.add_argument("folders", nargs="*", type=Path)
    given.add_argument("--scenes", nargs="*", choices=TASKS, default=list(TASKS))
    given.add_argument("--seed", type=int, default=0)
    arguments = given.parse_args()
    table = Table(_COLUMNS, f"every other contact of folders, all of runs with seed {arguments.seed}")
    for place in [*arguments.folders, *arguments.scenes]:
        folder = isinstance(place, Path)
        errors = errors_on(place) if folder else differences_in(place, arguments.seed)
        values = np.sqrt(np.mean(errors**2)), errors.mean(), np.abs(errors).max()
        name = f"{place.parent.name}/{place.name}" if folder else place
        table.row(name, len(errors), *(f"{1e3 * value:.2f}" for value in values))


if __name__ == "__main__":
    main()
