"""How fast recordings are replayed: python bench/replay.py BAG [BAG ...]

Reading, filter and writing of the new bag, without the start of Python and without the picture. Each is done
several times; the least is what the machine can, the rest is what else it did.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from pathlib import Path

from tactile_bringup.bag import read_bag
from tactile_bringup.replay import run_filter
from tactile_bringup.replay_inputs import Inputs, inputs_of, wanted_topics
from tactile_bringup.replay_output import write_bag
from tactile_bringup.replay_sweep import base_settings

PARTS = ("read", "prepare", "filter", "write", "all")


def main() -> None:
    """Measure the bags of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bags", type=Path, nargs="+")
    parser.add_argument("--repeat", type=int, default=9)
    arguments = parser.parse_args()
    names = ("recording", "s", "messages", "beliefs", *(f"{part} ms" for part in PARTS), "x real time")
    print(f"| {' | '.join(names)} |")
    print("| --- " * len(names) + "|")
    for bag in arguments.bags:
        print(measured(bag, arguments.repeat))


def measured(bag: Path, repeat: int) -> str:
    """A line of the table."""
    parts = []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(repeat):
            inputs, beliefs, times = once(bag, Path(folder) / str(number))
            parts.append(times)
    least = [min(column) * 1e3 for column in zip(*parts, strict=True)]
    whole = min(sum(row) for row in parts)
    cells = [bag.name, f"{inputs.span_s:.1f}", str(sum(inputs.bag.counts.values())), str(beliefs)]
    cells += [f"{value:.0f}" for value in (*least, whole * 1e3)] + [f"{inputs.span_s / whole:.0f}"]
    return f"| {' | '.join(cells)} |"


def once(bag: Path, out: Path) -> tuple[Inputs, int, list[float]]:
    """One replay: inputs, number of valid beliefs, and seconds of each part."""
    stamps = [time.perf_counter()]
    read = read_bag(bag, wanted_topics)
    stamps.append(time.perf_counter())
    inputs = inputs_of(read)
    stamps.append(time.perf_counter())
    settings = base_settings(inputs, None)
    runs = [run_filter(arm, settings[arm.name]) for arm in inputs.arms]
    stamps.append(time.perf_counter())
    write_bag(out, read, runs)
    stamps.append(time.perf_counter())
    beliefs = sum(belief.valid for run in runs for belief in run.beliefs)
    return inputs, beliefs, [b - a for a, b in itertools.pairwise(stamps)]


if __name__ == "__main__":
    main()
