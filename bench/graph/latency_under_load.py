"""Latency from exposure to command beside busy loops, with and without a real-time priority of the nodes.

Each row is one run of surface following on the simulated ramp, as real nodes, recorded::

    python bench/graph/latency_under_load.py [--loops 0 2 4 8] [--priorities 0 20]
"""

import itertools
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, busy, parser

from tactile_bringup.timing import measured


def main() -> None:
    """A row for each run."""
    arguments = parser(__doc__)
    arguments.add_argument("--loops", type=int, nargs="+", default=[0, 2, 4, 8])
    arguments.add_argument("--priorities", type=int, nargs="+", default=[0, 20])
    arguments.add_argument("task", nargs="*", default=["surface_following"])
    given = arguments.parse_args()
    heads = ("busy loops", "priority", "p50, p99 (ms)", "dropped, in silence", "exit code")
    table = Table(heads, "one run a row", timed=True)
    for loops, priority in itertools.product(given.loops, given.priorities):
        with busy(loops):
            values = measured([*given.task, "--priority", str(priority)])
        latency, frames = values.get("latency_ms", {}), values.get("frames", {})
        both = f"{latency['p50']:.1f}, {latency['p99']:.1f}" if latency else "no run: " + values["end"]
        lost = f"{sum(frames['lost'].values())} of {frames['exposed']}, {frames['silent']}" if frames else ""
        table.row(loops, priority, both, lost, values["exit"])


if __name__ == "__main__":
    main()
