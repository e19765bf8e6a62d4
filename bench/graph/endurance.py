"""Surface following over and over, as real nodes: what grows with time, process by process.

The same nodes do the task on the simulated ramp again and again, recorded; every ten seconds memory, threads
and file descriptors of each process and the shared memory in use are read. The table has their means over
each sixth of the time, and the latency from exposure to command over the same, from the bag. With `--client`
a client of `tactile foxglove` takes all topics, and each second all nodes are asked for all parameters; with
`--page` the page is open, drawn by nobody::

    python bench/graph/endurance.py [--minutes 60] [--priority 0] [--client] [--page] [--out out/endurance]
"""

import contextlib
import json
import os
import re
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

sys.path.extend(map(str, Path(__file__).resolve().parents[:2]))

from shared import Table, parser, percentiles

from tactile_bringup.launching.environment import free_domain_id
from tactile_bringup.launching.operator import Operator, OperatorError
from tactile_bringup.timing import LAUNCH
from tactile_records.runs.from_bag import read_arms

PERIOD, PARTS = 10.0, 6
SCENE = ["surface_following", "--scene", "ramp", "--headless"]
#: What a browser says first: a page counts as one that looks from then on.
CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.5, 0.5, 0.5), "fov": 0.8,
    "near": 0.01, "far": 100.0, "image_height": 800, "image_width": 1200, "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}  # fmt: skip
TICK = os.sysconf("SC_CLK_TCK")


class Viewer:
    """`tactile view` with a page that takes all that is sent, and draws nothing."""

    def __init__(self) -> None:
        command = [*LAUNCH[:-1], "view", "--port", "0"]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        self.address = re.search(r"http://[\d.:]+", self.process.stdout.readline())[0]  # type: ignore[index]
        self._ends = False
        self._started, self._before = time.monotonic(), self._used()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        import msgspec
        import viser

        where, protocol = self.address.replace("http", "ws"), Subprotocol(f"viser-v{viser.__version__}")
        with connect(where, origin=Origin(self.address), subprotocols=[protocol], max_size=None) as page:
            page.send(msgspec.msgpack.encode(CAMERA))
            while not self._ends:
                with contextlib.suppress(TimeoutError):
                    page.recv(0.2)

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


def look(folder: Path) -> dict[str, tuple[float, int, int]]:
    """Memory (MB), threads and descriptors by process of the run, and MB of shared memory in all."""
    found = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):
        process = Path("/proc", pid)
        try:
            words = process.joinpath("cmdline").read_bytes().decode(errors="replace").split("\0")
            marked = str(folder) in process.joinpath("environ").read_bytes().decode(errors="replace")
            if not marked or words[1:2] != ["-m"]:
                continue
            status = dict(line.split(":", 1) for line in process.joinpath("status").read_text().splitlines())
            name = words[2].rsplit(".", 1)[-1].replace("cli", words[3])
            memory, threads = int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"])
            found[f"{name} {pid}"] = (memory, threads, len(os.listdir(process / "fd")))
        except (OSError, KeyError):  # it has ended
            continue
    shared = 0
    for path in Path("/dev/shm").glob("fastdds_*"):
        with contextlib.suppress(FileNotFoundError):  # gone by now
            shared += path.stat().st_size
    return found | {"shared memory": (shared / 2**20, 0, 0)}


def table(samples: list[dict[str, tuple[float, int, int]]]) -> None:
    """Means over each part of the time, by process."""
    heads = ("process", *(f"part {n + 1}: MB, threads, descriptors" for n in range(PARTS)))
    printed = Table(heads, f"means, a look every {PERIOD:g} s", timed=True)
    parts = np.array_split(np.array(samples), PARTS)
    for name in filter(samples[0].__contains__, samples[-1]):
        for_each = (np.array([look[name] for look in part if name in look]).reshape(-1, 3) for part in parts)
        printed.row(name.split()[0], *(", ".join(f"{v:.1f}" for v in one.mean(axis=0)) for one in for_each))


def latencies(bag: Path) -> None:
    """Median and p99 from exposure to command in each part, and how often there was one."""
    (record,) = read_arms(bag).values()
    commands = record.command.rows(record.command.exposure_ns > 0)
    first = np.unique(commands.exposure_ns, return_index=True)[1]
    ms = (commands.stamp_ns[first] - commands.exposure_ns[first]) / 1e6
    cells = ["{:.1f}, {:.1f}".format(*percentiles(part)) for part in np.array_split(ms, PARTS)]
    print("| latency p50, p99 (ms) | " + " | ".join(cells) + " |")
    print(f"\n{len(ms)} beliefs acted on")


def take_all(address: str, count: Counter[str]) -> None:
    """A client of `tactile foxglove` that wants every topic, until that ends."""
    socket = connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None)
    with contextlib.suppress(ConnectionClosed), socket:
        for message in socket:
            count["messages"] += isinstance(message, bytes)
            channels = () if isinstance(message, bytes) else json.loads(message).get("channels", ())
            if channels:
                time.sleep(0.1)  # foxglove-sdk 0.30 refuses what is asked for while it is being offered
                wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
                socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def ask_all(domain: int, bridge: subprocess.Popen[str], count: Counter[str]) -> None:
    """Each second all parameters of all nodes, until the bridge ends."""
    with Operator(domain, looks=False) as operator:
        while bridge.poll() is None:
            operator.find(1.0, lambda: False)
            for node in operator.nodes_with_parameters():
                with contextlib.suppress(OperatorError):  # it starts, or has ended
                    count["parameters"] += len(operator.parameters(node))


def client(domain: int, count: Counter[str]) -> subprocess.Popen[str]:
    """Both of them beside this thread; returns the bridge, with which they end."""
    command = [*LAUNCH[:-1], "foxglove", "--port", "0"]
    bridge = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    address = re.search(r"ws://[\d.:]+", bridge.stdout.readline())[0]  # type: ignore
    threading.Thread(target=take_all, args=(address, count)).start()
    threading.Thread(target=ask_all, args=(domain, bridge, count)).start()
    return bridge


def main() -> int:
    """Run, watch and tell."""
    given = parser(__doc__ or "")
    given.add_argument("--minutes", type=float, default=60.0)
    given.add_argument("--priority", type=int, default=0, help="of the nodes, as in tactile launch")
    given.add_argument("--client", action="store_true", help="with a client and questions, see above")
    given.add_argument("--page", action="store_true", help="with a page of `tactile view` open")
    given.add_argument("--out", type=Path, default=Path("out/endurance"))
    arguments = given.parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=False)
    run, bag, domain = folder / "run", folder / "bag", free_domain_id()
    # by ENDURANCE its processes are known again
    os.environ |= {"ENDURANCE": str(folder), "ROS_DOMAIN_ID": str(domain)}
    command = [*LAUNCH, *SCENE, "--nodes-only", "--out", str(run), "--record", str(bag)]
    command += ["--priority", str(arguments.priority)]
    samples, count = [], Counter[str]()
    end = time.monotonic() + 60 * arguments.minutes
    with (folder / "log").open("w") as log:
        written: dict[str, Any] = {"stdout": log, "stderr": log}
        launched = subprocess.Popen(command, **written)
        bridge = client(domain, count) if arguments.client else None
        viewer = Viewer() if arguments.page else None
        doing = [*LAUNCH[:-1], "run", *SCENE]
        task = subprocess.Popen(doing, **written)
        while time.monotonic() < end and launched.poll() is None:
            if task.poll() is not None:
                count[f"runs that ended with {task.returncode}"] += 1
                task = subprocess.Popen(doing, **written)
            time.sleep(PERIOD)
            samples.append(look(folder))
        if viewer is not None:
            count["percent of a core for the page"] = round(100 * viewer.close())
        for process in filter(None, (task, bridge, launched)):
            process.terminate()
            process.wait()
    print(dict(count))
    settled = samples[3:-3]  # neither while it starts nor while it ends
    if len(settled) < PARTS:
        sys.exit(f"{len(samples)} looks are too few to say what grows: --minutes 2 or more")
    table(settled)
    latencies(bag)
    return launched.returncode


if __name__ == "__main__":
    sys.exit(main())
