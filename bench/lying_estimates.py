"""What estimates that lie lead to: for each task and each lie of `LYING_ESTIMATES`, held against the truth.

    python bench/lying_estimates.py [--fidelity fitted] [--tasks plane ...] [--lies "z flipped" ...]
        [--from-the-start] [--honest 100] [--out FILE.json]

Without `--from-the-start` a lie begins 3 s after the task's own work has. For each it says after how long the
arm was told to stop (known) and rested, how deep the tip came, and by how much deeper than
before the lie, how far the arm had gone until it rested, and what the user reads. `--honest N` runs each task
with N seeds and nobody who lies: none may be stopped.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_drivers.doubles.lying_estimates import LYING_ESTIMATES
from tactile_drivers.scene import load_scene
from tactile_records.runs.record import RunRecord

AFTER = 3.0  # s of work before the lie begins
FAR = 2**62
AT_REST = 1e-3  # m/s: below what any estimate's noise makes an arm do


@dataclass(frozen=True)
class Case:
    """A task on a scene, and whose estimates lie."""

    task: str
    scene: str
    arm: str
    goals: tuple[str, ...] = ()


CASES = {
    "plane": Case("surface_following", "plane", "arm"),
    "ramp": Case("surface_following", "ramp", "arm"),
    "dome": Case("surface_following", "dome", "arm", ("theta_1",)),
    "object_tracking": Case("object_tracking", "tracking_flat", "follower"),
    "pushing": Case("pushing", "pushing", "arm"),
    "dual_pushing follower": Case("dual_pushing", "dual_pushing", "follower"),
    "dual_pushing leader": Case("dual_pushing", "dual_pushing", "leader"),
}


def honest(case: Case, fidelity: str | None, seed: int) -> dict[str, RunRecord]:
    """A run in which nobody lies."""
    options = OfflineOptions(fidelity=fidelity, seed=seed, goals=case.goals)
    return run_arms_offline(case.scene, case.task, options)


def lying(
    case: Case, fidelity: str | None, seed: int, lie: str, begins: float
) -> dict[str, float | str | bool]:
    """The row of one lie."""
    lies = LYING_ESTIMATES[lie](begins, case.arm)
    options = OfflineOptions(fidelity=fidelity, seed=seed, goals=case.goals, lies=lies)
    records = run_arms_offline(case.scene, case.task, options)
    row: dict[str, float | str | bool] = {"lie": lie}
    liar = records[case.arm]
    begins_ns = max(lies.begins_ns, _touched_ns(liar))
    known_ns = min(_stopped_ns(record, begins_ns) for record in records.values())
    end_ns = int(liar.pose.stamp_ns[-1])
    row["known_s"] = (known_ns - begins_ns) / 1e9 if known_ns < end_ns else np.nan
    rest_ns = max(_rest_ns(record, known_ns) for record in records.values()) if known_ns < end_ns else end_ns
    row["rest_s"] = (rest_ns - begins_ns) / 1e9 if rest_ns < end_ns else np.nan
    with_truth = [record for record in records.values() if len(record.truth)]
    row["deepest_mm"] = max(_depth(record, begins_ns)[1] for record in with_truth)
    row["deeper_mm"] = max(deep - before for before, deep in (_depth(r, begins_ns) for r in with_truth))
    moved = liar.pose.rows((liar.pose.stamp_ns >= begins_ns) & (liar.pose.stamp_ns <= rest_ns))
    steps = np.diff(moved.T_base_sensor[:, :3, 3], axis=0)
    row["way_mm"] = 1e3 * float(np.linalg.norm(steps, axis=1).sum())
    row["succeeded"] = bool(liar.result["succeeded"])
    row["read"] = str(liar.result["reason"])
    return row


def _stopped_ns(record: RunRecord, after_ns: int) -> int:
    """The first command of a stop after that stamp, or of a failure; far away where there is none."""
    command = record.command
    found = (command.stamp_ns >= after_ns) & np.isin(command.phase, ("stopping", "failed"))
    return int(command.stamp_ns[found][0]) if found.any() else FAR


def _rest_ns(record: RunRecord, known_ns: int) -> int:
    """When the arm came to rest: from then on, or from when it was at rest already."""
    rests = np.linalg.norm(record.arm_twist.twist[:, :3], axis=1) < AT_REST
    stamp_ns = record.arm_twist.stamp_ns
    now = int(np.searchsorted(stamp_ns, known_ns))
    if not rests[now:].any():
        return int(stamp_ns[-1])
    first = now + int(rests[now:].argmax())
    if first == now:
        moving = np.flatnonzero(~rests[:now])
        first = int(moving[-1]) + 1 if len(moving) else 0
    return int(stamp_ns[first])


def _touched_ns(record: RunRecord) -> int:
    touching = record.presence.stamp_ns[record.presence.in_contact]
    return int(touching[0]) if len(touching) else 0


def _depth(record: RunRecord, begins_ns: int) -> tuple[float, float]:
    """The deepest before the lie began, while at work, and since then, mm."""
    depth, stamp_ns = 1e3 * record.truth.T_fs[:, 2, 3], record.truth.stamp_ns
    before = (stamp_ns < begins_ns) & record.working(stamp_ns)
    since = stamp_ns >= begins_ns
    return float(depth[before].max(initial=0.0)), float(depth[since].max(initial=0.0))


def rows(name: str, arguments: argparse.Namespace) -> Iterator[dict[str, float | str | bool]]:
    """The rows of one task."""
    case, begins = CASES[name], 0.0
    if not arguments.from_the_start:
        record = honest(case, arguments.fidelity, arguments.seed)[case.arm]
        begins = float(record.command.stamp_ns[record.command.phase == record.work][0]) / 1e9 + AFTER
    for lie in arguments.lies or LYING_ESTIMATES:
        yield {"task": name, **lying(case, arguments.fidelity, arguments.seed, lie, begins)}


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--fidelity", default="fitted")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tasks", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--lies", nargs="*", default=[])
    parser.add_argument("--from-the-start", action="store_true")
    parser.add_argument("--honest", type=int, default=0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    table = []
    for name in arguments.tasks:
        load_scene(CASES[name].scene)
        for seed in range(arguments.honest):
            for record in honest(CASES[name], arguments.fidelity, seed).values():
                print(
                    f"{name:22} {record.arm:9} {seed:4} {record.result['succeeded']}", record.result["reason"]
                )
        if arguments.honest:
            continue
        for row in rows(name, arguments):
            table.append(row)
            numbers = " ".join(f"{row[key]:7.2f}" for key in ("known_s", "rest_s", "deepest_mm", "deeper_mm"))
            print(
                f"{name:22} {row['lie']:28} {numbers} {row['way_mm']:7.1f} "
                f"{'done  ' if row['succeeded'] else 'failed'} {row['read']}",
                flush=True,
            )
    if arguments.out:
        arguments.out.write_text(json.dumps(table, indent=1))


if __name__ == "__main__":
    main()
