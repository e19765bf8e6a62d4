"""Latency from exposure to command beside busy loops, with and without a real-time priority of the nodes.

Each row is one run of surface following on the simulated ramp, as real nodes, recorded::

    python bench/latency_under_load.py [--loops 0 2 4 8] [--priorities 0 20] [--composed]

With --composed, each row also with estimator, filter and controller in one process (bench/composed_nodes.py).
"""

import argparse
import itertools
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tactile_bringup.timing import LAUNCH, measured


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Beside so many processes that never rest."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def measure(loops: int, priority: int, composed: bool, task: list[str]) -> dict:
    """The report of one run; empty but for its end if there is none."""
    one = [sys.executable, str(Path(__file__).with_name("composed_nodes.py"))]
    with busy(loops):
        return measured([*task, "--priority", str(priority)], one if composed else LAUNCH)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, nargs="+", default=[0, 2, 4, 8])
    parser.add_argument("--priorities", type=int, nargs="+", default=[0, 20])
    parser.add_argument("--composed", action="store_true", help="in one process, too")
    parser.add_argument("task", nargs="*", default=["surface_following"])
    arguments = parser.parse_args()
    print("| busy loops | priority | processes | p50, p99 (ms) | dropped: counted, in silence | exit code |")
    print("| --- | --- | --- | --- | --- | --- |")
    ways = [(False, "3"), (True, "1")] if arguments.composed else [(False, "3")]
    for loops, priority in itertools.product(arguments.loops, arguments.priorities):
        for composed, processes in ways:
            values = measure(loops, priority, composed, arguments.task)
            latency, frames = values.get("latency_ms", {}), values.get("frames", {})
            both = f"{latency['p50']:.1f}, {latency['p99']:.1f}" if latency else "no run: " + values["end"]
            lost = (
                f"{sum(frames['lost'].values())} of {frames['exposed']}, {frames['silent']}" if frames else ""
            )
            print(f"| {loops} | {priority} | {processes} | {both} | {lost} | {values['exit']} |", flush=True)


if __name__ == "__main__":
    main()
