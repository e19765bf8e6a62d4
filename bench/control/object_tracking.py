"""Object tracking in the loop without ROS: errors and lag by gains, by object and by speed (simulated).

    python bench/control/object_tracking.py gains        # the paper's gains, ours, and what each part brings
    python bench/control/object_tracking.py objects      # flat plate, cube, mustard bottle, soft ball
    python bench/control/object_tracking.py components   # 200 mm and 60 degrees, one after the other
    python bench/control/object_tracking.py speed        # 0.5 to 6 times the paper's speed

RMS errors are means over the seeds, with the deviation among them; "largest" is of all seeds. Lags are told
of runs that ended well, up to the second within which they are searched for. --picture FILE draws the errors
of the first seed.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task, task_path
from tactile_records.runs.euler_poses import COMPONENTS
from tactile_records.runs.object_tracking import NOT_KEPT, numbers
from tactile_records.runs.tracking import LONGEST_LAG, Tracking, tracking

PAPER, OURS = "object_tracking", "object_tracking_tuned"
FEEDFORWARD, NO_FEEDFORWARD = "follower.task.feedforward=1.0", "follower.task.feedforward=0.0"
PREDICTION = "follower.prediction.enabled=true"
DEPTH = "follower.servoing.reference=[0, 0, 0.004, 0, 0, 0]"
ROOM = [f"{arm}.limiter.{kind}" for arm in ("leader", "follower")
        for kind in ("linear_speed=2.0", "angular_speed=6.0")]  # fmt: skip
ROOM += [f"follower.surface.{room}" for room in ("speed=0.3", "turn_rate=3.0", "depth_margin=0.004")]
FILES = {"ours": OURS, "the paper's": PAPER}
OBJECTS = {
    "flat plate": "tracking_flat", "Rubik's cube": "tracking_cube",
    "mustard bottle": "tracking_mustard", "soft ball": "tracking_ball",
}  # fmt: skip
#: Parts of an error: unit, its factor, and which components.
ERRORS = (
    ("off along the surface (mm)", 1e3, [0, 1]),
    ("off along the normal (mm)", 1e3, [2]),
    ("tilt off (deg)", 180.0 / np.pi, [3, 4]),
)
SPEEDS = (0.5, 1.0, 2.0, 4.0, 6.0)

# table -> rows: name, scene, task, controller file, settings on top of it
Row = tuple[str, str, str, str, list[str]]
FLAT, ALL = OBJECTS["flat plate"], "object_tracking"
ROWS: dict[str, list[Row]] = {
    "gains": [
        ("the paper's", FLAT, ALL, PAPER, []),
        ("the paper's, 4 mm deep", FLAT, ALL, PAPER, [DEPTH]),
        ("the paper's, prediction", FLAT, ALL, PAPER, [PREDICTION]),
        ("the paper's, feedforward", FLAT, ALL, PAPER, [FEEDFORWARD]),
        ("ours without feedforward", FLAT, ALL, OURS, [NO_FEEDFORWARD]),
        ("ours without feedforward, prediction", FLAT, ALL, OURS, [NO_FEEDFORWARD, PREDICTION]),
        ("ours, motion_time 0.3 s", FLAT, ALL, OURS, ["follower.prediction.motion_time=0.3"]),
        ("ours", FLAT, ALL, OURS, []),
        ("ours, prediction", FLAT, ALL, OURS, [PREDICTION]),
    ],
    "objects": [
        (f"{name}, {gains}", scene, ALL, file, [])
        for name, scene in OBJECTS.items()
        for gains, file in FILES.items()
    ],
    "components": [(gains, FLAT, "object_tracking_components", file, []) for gains, file in FILES.items()],
    "speed": [
        (f"{factor:g} x, {gains}", FLAT, ALL, file, [f"leader.task.speed_factor={factor}", *ROOM])
        for gains, file in FILES.items()
        for factor in SPEEDS
    ],
}


def runs(row: Row, fidelity: str, seeds: int) -> Iterator[tuple[dict, Tracking]]:
    """The follower's report of each run, and how it went along."""
    _, scene, task, controller, changes = row
    loaded = load_task(task_path(task), scene, controller=controller, changes=changes)
    for seed in range(seeds):
        run = run_arms_offline(scene, loaded, OfflineOptions(fidelity=fidelity, seed=seed, time_limit=900.0))
        yield numbers(run["follower"], run), tracking(run["follower"], run["leader"])


def spread(values: Sequence[dict[str, float]], components: Sequence[str]) -> str:
    """Means of components over runs, and the deviation among several."""
    table = np.array([[value[name] for name in components] for value in values])
    deviations = table.std(axis=0, ddof=1) if len(table) > 1 else None
    texts = [f"{mean:.2f}" for mean in table.mean(axis=0)]
    if deviations is not None:
        texts = [f"{text} ± {deviation:.2f}" for text, deviation in zip(texts, deviations, strict=True)]
    return ", ".join(texts)


def cells(found: Sequence[dict]) -> list[str]:
    """One line of a table."""
    tracks = [values["tracking"] for values in found]
    well = [values["succeeded"] or values["reason"].startswith(NOT_KEPT) for values in found]
    contact = f"{100.0 * min(values['contact_fraction'] for values in found):.1f} %"
    failed = f"; {len(found) - sum(well)} of {len(found)} failed" if not all(well) else ""
    position, rotation = COMPONENTS[:3], COMPONENTS[3:]
    rms = [track["rms"] for track in tracks]
    largest = [max(track["largest"][name] for track in tracks) for name in COMPONENTS]
    lags = [
        [track[name] for track, good in zip(tracks, well, strict=True) if good]
        for name in ("lag_ms", "angular_lag_ms")
    ]
    searched = 0.99e3 * LONGEST_LAG
    shown = [f"{np.mean(lag):.0f}" if lag and max(lag) < searched else "-" for lag in lags]
    return [
        contact + failed,
        *(spread(rms, names) for names in (position, rotation)),
        *(", ".join(f"{value:.2f}" for value in part) for part in (largest[:3], largest[3:])),
        " / ".join(shown),
    ]


def draw(path: Path, tracks: dict[str, Tracking]) -> None:
    """Errors over time: a column an object, with all its gains."""
    names = list(dict.fromkeys(name.rpartition(", ")[0] for name in tracks))
    figure = Figure(figsize=(3.2 * len(names), 7.0), layout="constrained")
    grid = figure.subplots(len(ERRORS), len(names), squeeze=False, sharex=True, sharey="row")
    for row, (unit, scale, which) in zip(grid, ERRORS, strict=True):
        for axes, name in zip(row, names, strict=True):
            for k, (full, track) in enumerate(each for each in tracks.items() if each[0].startswith(name)):
                seconds = (track.stamp_ns - track.stamp_ns[0]) / SECOND_NS
                size = np.linalg.norm(track.error[:, which], axis=1) * scale
                axes.plot(seconds, size, color=f"C{k}", label=full.rpartition(", ")[2])
            axes.grid(alpha=0.3)
        row[0].set_ylabel(unit)
    for axes, name in zip(grid[0], names, strict=True):
        axes.set_title(name)
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    grid[0, 0].legend()
    figure.savefig(path, dpi=90)


def main() -> None:
    """Print one of the tables."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("table", choices=tuple(ROWS))
    arguments.add_argument("--fidelity", choices=("ideal", "fitted", "input", "image"), default="image")
    arguments.add_argument("--seeds", type=int, default=3)
    arguments.add_argument("--only", nargs="+", default=[], help="rows of these names")
    arguments.add_argument("--picture", type=Path, metavar="FILE", help="of the errors of seed 0 (PNG)")
    given = arguments.parse_args()
    statistic = f"{given.fidelity}, seeds 0 to {given.seeds - 1}"
    heads = ["contact, least", "RMS x, y, z [mm]", "RMS α, β, γ [deg]", "largest x, y, z [mm]",
             "largest α, β, γ [deg]", "lag, in rotation"]  # fmt: skip
    table = Table([given.table, *heads], f"{statistic}; lag in ms")
    goals, tracks = {}, {}
    for row in ROWS[given.table]:
        if not given.only or row[0] in given.only:
            found, ways = zip(*runs(row, given.fidelity, given.seeds), strict=True)
            tracks[row[0]] = ways[0]
            table.row(row[0], *cells(found))
            goals[row[0]] = [values["tracking"]["goals"] for values in found]
    if given.picture is not None:
        draw(given.picture, tracks)
    if given.table == "components":
        table = Table(["RMS x, y, z [mm], α, β, γ [deg] while the leader moves along", *goals], statistic)
        for goal in next(iter(goals.values()))[0]:
            of = ([run[goal]["rms"] for run in each] for each in goals.values())
            table.row(goal, *(spread(values, COMPONENTS) for values in of))


if __name__ == "__main__":
    main()
