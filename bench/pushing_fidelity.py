"""What each level of fidelity costs in a push, and how far its table of pushing is from that of the images.

    python bench/pushing_fidelity.py --out out/pushing_fidelity [--trials 5] [--table single]
        [--objects blue_square ...] [--floors mdf] [--fidelities image input fitted ideal plane]
        [--batches | --parts]

Runs the same trials of a table at each level, in this process (`plane`: all of them at once, by
`bench/pushing_plane.py` with the network's errors); a row a trial is kept in the
folder, so that an interrupted run goes on and more trials can be added. Times are processor time; a fixed
piece of NumPy work, timed before and after each push, tells how fast the machine was meanwhile. `--parts`
tells instead what the parts of one push take, of the first of the fidelities.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from pushing_options import Option, outcome
from pushing_plane import Physics

from tactile_base.stamps import SECOND_NS
from tactile_bringup.experiment import Common, Trial, numbers_of, table_of, trial_run
from tactile_bringup.trials import Row, TrialRows
from tactile_control.phase_machine import PhaseMachine
from tactile_drivers.safety import SafeArm
from tactile_drivers.sim.cell import Cell
from tactile_drivers.sim.simulation import FIDELITIES
from tactile_filter.bayes_filter import ContactFilter

PLANE = "plane"
LEVELS = (*FIDELITIES, PLANE)

#: What a run calls, and the part of the pipeline that it is; none of them calls another.
PARTS: dict[str, tuple[tuple[type, str], ...]] = {
    "controller (task)": ((PhaseMachine, "step"),),
    "safe command stage": ((SafeArm, "command"), (SafeArm, "take_state")),
    "filter": ((ContactFilter, "observe"),),
    "arm and pushed object": ((Cell, "step"),),
    "sensor": ((Cell, "expose"),),
}


@dataclass(frozen=True)
class Push:
    """A trial at one level."""

    trial: Trial

    @property
    def name(self) -> str:
        return f"{self.trial.common.fidelity}/{self.trial.name}"

    def row(self, **numbers: Any) -> Row:
        """What is kept of it."""
        trial = self.trial
        about = {"fidelity": trial.common.fidelity, "object": trial.object, "floor": trial.floor}
        return {"name": self.name, **about, **numbers}


def reference_time() -> float:
    """Best of several, s: 4000 products of 4x4 matrices one after the other, and their sums."""
    A, times = np.full((4, 4), 0.25), []
    for _ in range(5):
        started = time.process_time()
        T = np.eye(4)
        for _ in range(4000):
            T = A @ T
            T[:3, 3] += 1e-6
        times.append(time.process_time() - started)
    return min(times)


def timed(push: Push) -> Row:
    """The trial's row with its processor time, and the reference's meanwhile (s)."""
    before = reference_time()
    started = time.process_time()
    run = trial_run(push.trial)
    cpu_s = time.process_time() - started
    stamps, numbers = next(iter(run.values())).pose.stamp_ns, numbers_of(run)
    return push.row(
        error_mm=numbers["push"]["error_mm"],
        succeeded=numbers["succeeded"],
        simulated_s=float(stamps[-1] - stamps[0]) / SECOND_NS,
        cpu_s=cpu_s,
        reference_s=0.5 * (before + reference_time()),
    )


def timed_together(pushes: list[Push]) -> list[Row]:
    """Rows of trials that run side by side in the plane, with equal parts of the time."""
    if not pushes:
        return []
    trials = [(push.trial.object, push.trial.floor, push.trial.number) for push in pushes]
    before = reference_time()
    started = time.process_time()
    found = outcome(pushes[0].trial.common.table, Option(physics=Physics(network=True)), trials)
    cpu_s = (time.process_time() - started) / len(trials)
    reference_s = 0.5 * (before + reference_time())
    return [
        push.row(
            error_mm=float(found.error[i]),
            succeeded=not found.missed[i],
            simulated_s=float(found.seconds[i]),
            cpu_s=cpu_s,
            reference_s=reference_s,
        )
        for i, push in enumerate(pushes)
    ]


def show(rows: list[Row], fidelities: list[str]) -> None:
    """Print time and error by level, and the paired differences from the first level."""
    by = {name: {r["name"].split("/", 1)[1]: r for r in rows if r["fidelity"] == name} for name in fidelities}
    base = by[fidelities[0]]
    print(f"{'':8s}{'pushes':>7s}{'CPU s':>8s}{'x real':>8s}{'/ ref':>7s}{'error mm':>16s}{'failed':>7s}"
          f"{'from ' + fidelities[0] + ': mean':>18s}{'SD':>7s}{'largest':>8s}")  # fmt: skip
    for name, level in by.items():
        done = [r for r in level.values() if r["succeeded"]]
        if not done:
            continue
        errors = np.array([r["error_mm"] for r in done])
        cpu = np.array([r["cpu_s"] for r in done])
        # the best of all: what the others took longer was the machine's other work
        relative = min(r["cpu_s"] / r["simulated_s"] / r["reference_s"] for r in done)
        rate = max(r["simulated_s"] / r["cpu_s"] for r in done)
        pairs = [(r["error_mm"], base[key]["error_mm"]) for key, r in level.items()
                 if r["succeeded"] and key in base and base[key]["succeeded"]]  # fmt: skip
        apart = np.subtract(*np.array(pairs).T) if pairs else np.full(1, np.nan)
        print(f"{name:8s}{len(done):7d}{cpu.min():8.2f}{rate:8.1f}{relative:7.2f}"
              f"{errors.mean():8.2f} +- {errors.std():4.2f}{len(level) - len(done):7d}"
              f"{apart.mean():18.2f}{apart.std():7.2f}{np.abs(apart).max():8.2f}")  # fmt: skip
    print("\nmean error (mm) by row of the table")
    for row in dict.fromkeys((r["object"], r["floor"]) for r in rows):
        cells = []
        for name in fidelities:
            found = [r["error_mm"] for r in by[name].values()
                     if (r["object"], r["floor"]) == row and r["succeeded"]]  # fmt: skip
            cells.append(f"{name} {np.mean(found):6.2f} +- {np.std(found):4.2f}" if found else f"{name} -")
        print(f"{row[0]:16s}{row[1]:6s}" + "   ".join(cells))


def batch_times() -> None:
    """Time of the shipped network for one image in batches of several, on one thread."""
    from tactile_perception.estimator import Estimator

    estimator = Estimator()
    size = estimator.metadata.preprocessing.size
    for count in (1, 2, 4, 8, 16, 32):
        images = np.random.default_rng(0).random((count, 1, size, size)).astype(np.float32)
        times = []
        for _ in range(max(8, 200 // count)):
            started = time.perf_counter()
            estimator.predict_uncalibrated(images)
            times.append((time.perf_counter() - started) / count)
        best, median = min(times) * 1e3, np.median(times) * 1e3
        print(f"batch of {count:2d}: best {best:.3f} ms, median {median:.3f} ms an image")


def part_times(trial: Trial) -> None:
    """Time that the parts of a push take, and how fast it would be if all but one took none."""
    spent: Counter[str] = Counter()

    def clocked(part: str, call: Callable[..., Any]) -> Callable[..., Any]:
        def timed_call(*arguments: Any, **named: Any) -> Any:
            started = time.thread_time()
            try:
                return call(*arguments, **named)
            finally:
                spent[part] += time.thread_time() - started

        return timed_call

    for part, calls in PARTS.items():
        for owner, name in calls:
            setattr(owner, name, clocked(part, getattr(owner, name)))
    best: Counter[str] = Counter()
    for _ in range(5):
        spent.clear()
        started = time.thread_time()
        run = trial_run(trial)
        spent["all"] = time.thread_time() - started
        best = best & spent if best else Counter(spent)  # the least of each: other work only adds
    poses = next(iter(run.values())).pose.stamp_ns
    simulated_s, steps = float(poses[-1] - poses[0]) / SECOND_NS, len(poses)
    best["the loop, records and clocks"] = best["all"] - sum(best[part] for part in PARTS)
    for part, seconds in best.items():
        times = simulated_s / seconds
        print(f"{part:30s}{1e6 * seconds / steps:7.1f} us a step, alone {times:6.0f} times real time")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/pushing_fidelity"))
    parser.add_argument("--trials", type=int, default=5, help="of each row of the table")
    parser.add_argument("--table", choices=("single", "dual", "tall"), default="single")
    parser.add_argument("--objects", nargs="+", default=())
    parser.add_argument("--floors", nargs="+", default=("mdf",))
    parser.add_argument("--fidelities", nargs="+", choices=LEVELS, default=LEVELS)
    parser.add_argument("--batches", action="store_true", help="time the network in batches, nothing else")
    parser.add_argument("--parts", action="store_true", help="time the parts of one push, nothing else")
    arguments = parser.parse_args()
    if arguments.batches:
        batch_times()
        return
    if arguments.parts:
        thing, floor = table_of(arguments.table).rows(arguments.objects, arguments.floors)[0]
        part_times(Trial(Common(arguments.table, fidelity=arguments.fidelities[0]), thing, floor, 0))
        return
    arguments.out.mkdir(parents=True, exist_ok=True)
    kept = TrialRows(arguments.out / "trials.jsonl")
    pushes = [
        Push(Trial(Common(arguments.table, fidelity=fidelity), thing, floor, number))
        for number in range(arguments.trials)
        for thing, floor in table_of(arguments.table).rows(arguments.objects, arguments.floors)
        for fidelity in arguments.fidelities
    ]
    missing = kept.missing(pushes)
    for push in missing:
        if push.trial.common.fidelity != PLANE:
            kept.add(timed(push))
    for row in timed_together([push for push in missing if push.trial.common.fidelity == PLANE]):
        kept.add(row)
    show(kept.of(pushes), list(arguments.fidelities))


if __name__ == "__main__":
    main()
