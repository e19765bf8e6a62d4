"""What looking costs: latency of a task, and processor time of `tactile view`, with and without open pages.

Each row is one run of surface following on the simulated ramp, as real nodes, recorded::

    python bench/graph/looking.py [--pages none 0 1 3] [--rounds 3] [--priority 20]

"none" is without a viewer. A page is a client of its web socket that takes all that is sent and draws
nothing: what drawing takes is the browser's, and usually of a graphics card.
"""

import asyncio
import os
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, needs, parser

from tactile_bringup.launching.environment import free_domain_id
from tactile_bringup.timing import LAUNCH, measured

#: What a browser says first: a page counts as one that looks from then on.
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.5, 0.5, 0.5), "fov": 0.8,
    "near": 0.01, "far": 100.0, "image_height": 800, "image_width": 1200, "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
TICK = os.sysconf("SC_CLK_TCK")


class Viewer:
    """`tactile view` with some pages, and what it has used."""

    def __init__(self, pages: int) -> None:
        command = [*LAUNCH[:-1], "view", "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address = re.search(r"http://[\d.:]+", self.process.stdout.readline())[0]  # type: ignore[index]
        self._ends = False
        self._started, self._before = time.monotonic(), self._used()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._look(pages)))
        self._thread.start()

    async def _look(self, pages: int) -> None:
        await asyncio.gather(*(self._page() for _ in range(pages)))

    async def _page(self) -> None:
        import msgspec
        import viser
        import websockets

        where, version = self.address.replace("http", "ws"), f"viser-v{viser.__version__}"
        async with websockets.connect(
            where, origin=self.address, subprotocols=[version], max_size=None
        ) as page:
            await page.send(msgspec.msgpack.encode(CAMERA))
            while not self._ends:
                try:
                    await asyncio.wait_for(page.recv(), 0.2)
                except asyncio.TimeoutError:
                    continue

    def _used(self) -> float:
        """Processor time so far, s."""
        words = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(words[11]) + int(words[12])) / TICK

    def close(self) -> float:
        """End it; the part of a core that it has used."""
        seconds, used = time.monotonic() - self._started, self._used() - self._before
        self._ends = True
        self._thread.join()
        self.process.terminate()
        self.process.wait()
        return used / seconds


def main() -> None:
    """A row for each run, in turns, so that a slow minute of the machine meets all of them."""
    arguments = parser(__doc__)
    arguments.add_argument("--pages", nargs="+", default=["none", "0", "1", "3"])
    arguments.add_argument("--rounds", type=int, default=3)
    arguments.add_argument("--priority", type=int, default=20)
    given = arguments.parse_args()
    needs("pip install viser websockets", "viser", "websockets")
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())
    heads = ("pages", "p50, p99 (ms)", "dropped, at work, in silence", "core of the viewer", "exit code")
    table = Table(heads, "one run a row", timed=True)
    for _ in range(given.rounds):
        for pages in given.pages:
            viewer = None if pages == "none" else Viewer(int(pages))
            values = measured(["surface_following", "--priority", str(given.priority)])
            used = 0.0 if viewer is None else viewer.close()
            latency, frames = values.get("latency_ms", {}), values.get("frames", {})
            both = f"{latency['p50']:.1f}, {latency['p99']:.1f}" if latency else "no run: " + values["end"]
            lost = (
                f"{sum(frames['lost'].values())} of {frames['exposed']}, {frames['lost_at_work']}, "
                f"{frames['silent']}"
                if frames
                else ""
            )
            table.row(pages, both, lost, f"{used:.0%}", values["exit"])


if __name__ == "__main__":
    main()
