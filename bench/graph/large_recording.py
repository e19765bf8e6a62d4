"""What `tactile view` takes of a recording that is larger than the memory: to open, to seek, to look through.

The recording is a short one with images, again and again with later stamps::

    tactile demo --record-images
    python bench/graph/large_recording.py out/demo/bag [--gigabytes 5] [--folder /tmp]

"cut" is the same file without its end, as of a recorder that was killed, or still records. A place that was
not shown before is sought 20 times, drawn evenly; each row is a process of its own.
"""

import multiprocessing
import random
import resource
import shutil
import struct
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from shared import Table, parser

from tactile_base.topics import Topic
from tactile_records.bags.reader import read_bag
from tactile_records.bags.writer import BagWriter
from tactile_view.cell_state import CellState
from tactile_view.recording import Recording

PLACES, CUT = 20, 20_000  # sought; bytes at the end
_STAMP = struct.Struct("<iI")


def repeated(short: Path, folder: Path, size: float) -> Path:
    """A recording of so many bytes in a folder; its file."""
    bag = read_bag(short)
    ordered = sorted(bag.messages, key=lambda message: message.received_ns)
    length, shift = ordered[-1].received_ns - ordered[0].received_ns + 10**7, 0
    stamped = {name for name, text in bag.definitions.items() if "Header header" in text.split("===")[0]}
    with BagWriter(folder, [Topic(*item) for item in bag.types.items()], bag.definitions, bag.note) as writer:
        while writer.file.stat().st_size < size:
            flushed = 0
            for topic, kind, data, received_ns, published_ns in ordered:
                if kind in stamped:
                    sec, nanosec = _STAMP.unpack_from(data, 4)
                    data = data[:4] + _STAMP.pack(*divmod(10**9 * sec + nanosec + shift, 10**9)) + data[12:]
                writer.write(topic, data, received_ns + shift, published_ns + shift)
                if received_ns - flushed > 5 * 10**8:
                    flushed = received_ns
                    writer.flush()
            shift += length
    return writer.file


def row(kind: str, file: Path) -> tuple[str, ...]:
    """What a recording takes."""
    start = time.monotonic()
    state = CellState()
    recording = Recording(file, state)
    state.types = recording.types
    opened, sought = time.monotonic() - start, []
    for _ in range(PLACES):
        start = time.monotonic()
        recording.seek(random.uniform(0.0, recording.duration))
        sought.append(time.monotonic() - start)
    start = time.monotonic()
    while recording.look_on():
        pass
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return (
        kind, f"{file.stat().st_size / 1e9:.1f} GB, {recording.duration:.0f} s", f"{opened:.2f}",
        f"{np.median(sought):.2f}, {max(sought):.2f}", f"{time.monotonic() - start:.0f}", f"{memory:.0f}",
    )  # fmt: skip


def main() -> None:
    """A row for each kind."""
    arguments = parser(__doc__)
    arguments.add_argument("bag", type=Path)
    arguments.add_argument("--gigabytes", type=float, default=5.0)
    arguments.add_argument("--folder", type=Path, default=Path("/tmp"))
    given = arguments.parse_args()
    folder = given.folder / "tactile_large_recording"
    try:
        file = repeated(given.bag, folder, 1e9 * given.gigabytes)
        seconds = ("opened (s)", "sought: median, longest (s)", "looked through (s)")
        heads = ("file", "size", *seconds, "memory (MB)")
        table = Table(heads, "each in a process of its own", timed=True)
        for kind in ("whole", "cut"):
            if kind == "cut":
                with file.open("r+b") as stream:
                    stream.truncate(file.stat().st_size - CUT)
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                table.row(*pool.apply(row, (kind, file)))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
