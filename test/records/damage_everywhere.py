"""What is left of a recording that is cut or flipped: python damage_everywhere.py BAG [--cuts N] [--flips N]

The bag is copied to MCAP and to sqlite3. Each file is cut at so many places and has single bits turned at so
many others, and is then read, replayed and reported on, in a process of its own whose time and memory are
measured. Printed are the outcomes (see `outcome` in damaged_bags.py) and the most time and
memory, over twice the file's size; errors that are no refusals are printed whole.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))

from damaged_bags import as_sqlite, cuts, damage, flips, outcome, use

from tactile_records.bags.contents import Bag
from tactile_records.bags.reader import read_bag

TIME_LIMIT = 60  # s
OUTCOMES = ("whole", "told", "refused", "altered", "silent", "error", "killed")


def attempt(folder: Path, whole: Bag) -> tuple[str, float, float]:
    """Outcome, seconds and MB of a process that reads and uses the bag."""
    reading, writing = os.pipe()
    started = time.monotonic()
    child = os.fork()
    if child == 0:
        signal.alarm(TIME_LIMIT)
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            found = outcome(folder, whole)
            use(folder)
        except BaseException:
            traceback.print_exc()
            found = "error"
        peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1000
        os.write(writing, f"{found} {peak}".encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as stream:
        found, _, peak = stream.read().partition(" ")
    os.waitpid(child, 0)
    return found or "killed", time.monotonic() - started, float(peak or "nan")


def measure(folder: Path, whole: Bag, places: list[tuple[str, int]]) -> str:
    """A row of the table: one file, damaged at these places."""
    file = next(path for path in folder.iterdir() if path.suffix in (".mcap", ".db3"))
    data = file.read_bytes()
    counts: Counter[str] = Counter()
    seconds, memory = 0.0, 0.0
    for kind, place in places:
        file.write_bytes(damage(data, kind, place))
        found, took, peak = attempt(folder, whole)
        counts[found] += 1
        if found in ("silent", "error", "killed"):
            print(f"{file.name}, {kind} {place}: {found}", file=sys.stderr)
        seconds, memory = max(seconds, took), max(memory, peak - 2e-6 * len(data))
    file.write_bytes(data)
    values = " | ".join(str(counts[name]) for name in OUTCOMES)
    kind = f"{file.suffix[1:]}, {len(places)} {places[0][0]}s"
    return f"| {kind} | {values} | {seconds:.1f} | {memory:.0f} |"


def main() -> None:
    """Damage the bag of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument("--flips", type=int, default=500)
    arguments = parser.parse_args()
    whole = read_bag(arguments.bag)
    print(f"| damage | {' | '.join(OUTCOMES)} | most s | most MB |")
    print("| --- " * (len(OUTCOMES) + 3) + "|")
    with tempfile.TemporaryDirectory(prefix="tactile_damage_") as name:
        mcap = Path(name) / "mcap"
        shutil.copytree(arguments.bag, mcap)
        for folder in (mcap, as_sqlite(whole, Path(name) / "sqlite")):
            size = max(path.stat().st_size for path in folder.iterdir())
            for places in (cuts(size, arguments.cuts), flips(size, arguments.flips)):
                print(measure(folder, whole, list(places)), flush=True)


if __name__ == "__main__":
    main()
