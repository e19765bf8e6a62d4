"""Object tracking in the loop without ROS: errors and lag by gains, by object and by speed (simulated).

    python bench/object_tracking.py gains        # the paper's gains, ours, and what each part brings
    python bench/object_tracking.py objects      # flat plate, cube, mustard bottle, soft ball
    python bench/object_tracking.py components   # 200 mm and 60 degrees, one after the other
    python bench/object_tracking.py speed        # 0.5 to 6 times the paper's speed

The tables in docs/results/tracking.md are its output.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_control.task_file import load_task, task_path
from tactile_records.runs.euler_poses import COMPONENTS
from tactile_records.runs.object_tracking import NOT_KEPT, numbers

PAPER, OURS = "object_tracking", "object_tracking_tuned"
FEEDFORWARD, NO_FEEDFORWARD = "follower.task.feedforward=1.0", "follower.task.feedforward=0.0"
PREDICTION = "follower.prediction.enabled=true"
DEPTH = "follower.servoing.reference=[0, 0, 0.004, 0, 0, 0]"

# name, controller file, settings on top of it
GAINS: list[tuple[str, str, list[str]]] = [
    ("the paper's", PAPER, []),
    ("the paper's, 4 mm deep", PAPER, [DEPTH]),
    ("the paper's, prediction", PAPER, [PREDICTION]),
    ("the paper's, feedforward", PAPER, [FEEDFORWARD]),
    ("ours without feedforward", OURS, [NO_FEEDFORWARD]),
    ("ours without feedforward, prediction", OURS, [NO_FEEDFORWARD, PREDICTION]),
    ("ours, motion_time 0.3 s", OURS, ["follower.prediction.motion_time=0.3"]),
    ("ours", OURS, []),
    ("ours, prediction", OURS, [PREDICTION]),
]
OBJECTS = ("tracking_flat", "tracking_cube", "tracking_mustard", "tracking_ball")
SPEEDS = (0.5, 1.0, 2.0, 4.0, 6.0)


def measure(
    scene: str,
    controller: str,
    changes: Sequence[str],
    fidelity: str,
    seed: int,
    task: str = "object_tracking",
) -> dict[str, object]:
    """The follower's report of one run."""
    loaded = load_task(task_path(task), scene, controller=controller, changes=changes)
    options = OfflineOptions(fidelity=fidelity, seed=seed, time_limit=900.0)
    run = run_arms_offline(scene, loaded, options)
    return numbers(run["follower"], run)


def row(name: str, values: dict) -> list[str]:
    """One line of a table."""
    track = values["tracking"]
    ended = values["succeeded"] or values["reason"].startswith(NOT_KEPT)  # which the numbers show
    lost = "" if ended else f": {values['reason']}"
    return [
        name,
        f"{100.0 * values['contact_fraction']:.1f} %{lost}",
        *(f"{track['rms'][c]:.2f}" for c in COMPONENTS),
        *(f"{track['largest'][c]:.2f}" for c in COMPONENTS),
        f"{track['lag_ms']:.0f} / {track['angular_lag_ms']:.0f}",
    ]


def table(first: str, rows: Iterable[list[str]]) -> None:
    """Print a table as its rows come."""
    units = ["mm"] * 3 + ["deg"] * 3
    heads = [f"{c} [{u}]" for c, u in zip(COMPONENTS, units, strict=True)]
    header = [
        first,
        "contact",
        *(f"RMS {h}" for h in heads),
        *(f"max {h}" for h in heads),
        "lag, in rotation [ms]",
    ]
    print("| " + " | ".join(header) + " |\n|" + " --- |" * len(header))
    for cells in rows:
        print("| " + " | ".join(cells) + " |", flush=True)


def gains(fidelity: str, seed: int) -> None:
    """All six components at once, on the flat plate, with several gains."""
    runs = ((name, measure("tracking_flat", file, changes, fidelity, seed)) for name, file, changes in GAINS)
    table("gains", (row(name, values) for name, values in runs))


def objects(fidelity: str, seed: int) -> None:
    """All six components at once, with each object, with the paper's gains and ours."""
    runs = (
        (f"{scene.removeprefix('tracking_')}, {'the paper’s' if file == PAPER else 'our'} gains",
         measure(scene, file, [], fidelity, seed))
        for scene in OBJECTS for file in (PAPER, OURS)
    )  # fmt: skip
    table("object", (row(name, values) for name, values in runs))


def components(fidelity: str, seed: int) -> None:
    """One component after the other, on the flat plate."""
    for name, file in (("the paper's gains", PAPER), ("our gains", OURS)):
        values = measure("tracking_flat", file, [], fidelity, seed, "object_tracking_components")
        print(f"{name}:")
        table("", [row("all", values)])
        goals = values["tracking"]["goals"]
        print("| goal | " + " | ".join(f"RMS {c}" for c in COMPONENTS) + " |\n|" + " --- |" * 7)
        for goal, of_goal in goals.items():
            print(
                f"| {goal} | " + " | ".join(f"{of_goal['rms'][c]:.2f}" for c in COMPONENTS) + " |", flush=True
            )


def speed(fidelity: str, seed: int) -> None:
    """All six components at once, faster and faster; the leader's own limits are out of the way."""
    room = ["leader.limiter.linear_speed=2.0", "leader.limiter.angular_speed=6.0",
            "follower.limiter.linear_speed=2.0", "follower.limiter.angular_speed=6.0"]  # fmt: skip
    runs = (
        (f"{factor:g} x, {'the paper’s' if file == PAPER else 'our'} gains",
         measure("tracking_flat", file, [f"leader.task.speed_factor={factor}", *room], fidelity, seed))
        for file in (PAPER, OURS) for factor in SPEEDS
    )  # fmt: skip
    table("speed", (row(name, values) for name, values in runs))


def main() -> None:
    """Print one of the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", choices=("gains", "objects", "components", "speed"))
    parser.add_argument("--fidelity", choices=("ideal", "image"), default="image")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    {"gains": gains, "objects": objects, "components": components, "speed": speed}[arguments.table](
        arguments.fidelity, arguments.seed
    )


if __name__ == "__main__":
    main()
