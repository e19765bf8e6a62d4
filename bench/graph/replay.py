"""How fast recordings are replayed.

    python bench/graph/replay.py BAG [BAG ...] [--repeat 9]

Reading, filter and writing of the new bag, without the start of Python and without the picture, in processor
time, which does not count what else the machine does; and all of it by the clock. The least of several times.
"Valid beliefs" are fewer than the states of a recording, of which some have none.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser

from tactile_records.bags.reader import read_bag
from tactile_records.replay.inputs import Inputs, inputs_of
from tactile_records.replay.output import write_bag
from tactile_records.replay.run import run_filter
from tactile_records.replay.sweep import base_settings
from tactile_records.replay.topics import wanted_topics

PARTS = ("read", "prepare", "filter", "write", "all")


def main() -> None:
    """Measure the bags of the command line."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("bags", type=Path, nargs="+")
    arguments.add_argument("--repeat", type=int, default=9)
    given = arguments.parse_args()
    heads = ("recording", "s", "messages", "valid beliefs", *(f"{part} ms" for part in PARTS))
    table = Table((*heads, "x real time", "x by the clock"), f"least of {given.repeat}", timed=True)
    for bag in given.bags:
        table.row(*measured(bag, given.repeat))


def measured(bag: Path, repeat: int) -> list[str]:
    """A line of the table."""
    parts, clock = [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(repeat):
            started = time.perf_counter()
            inputs, beliefs, times = once(bag, Path(folder) / str(number))
            clock.append(time.perf_counter() - started)
            parts.append((*times, sum(times)))
    least = [min(column) for column in zip(*parts, strict=True)]
    cells = [bag.name, f"{inputs.span_s:.1f}", str(sum(inputs.bag.counts.values())), str(beliefs)]
    cells += [f"{value * 1e3:.0f}" for value in least]
    return [*cells, f"{inputs.span_s / least[-1]:.0f}", f"{inputs.span_s / min(clock):.0f}"]


def once(bag: Path, out: Path) -> tuple[Inputs, int, list[float]]:
    """One replay: inputs, number of valid beliefs, and seconds of processor time of each part."""
    stamps = [time.process_time()]
    read = read_bag(bag, wanted_topics)
    stamps.append(time.process_time())
    inputs = inputs_of(read)
    stamps.append(time.process_time())
    settings = base_settings(inputs, None)
    runs = [run_filter(arm, settings[arm.name]) for arm in inputs.arms]
    stamps.append(time.process_time())
    write_bag(out, read, runs)
    stamps.append(time.process_time())
    beliefs = sum(belief.valid for run in runs for belief in run.beliefs)
    return inputs, beliefs, [b - a for a, b in itertools.pairwise(stamps)]


if __name__ == "__main__":
    main()
