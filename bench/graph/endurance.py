"""Surface following over and over, as real nodes: what grows with time, process by process.

A task of many equal goals runs on the simulated ramp, recorded; every ten seconds memory, threads and file
descriptors of each process and the shared memory in use are read. The table has their means over each sixth
of the time, and the latency from exposure to command over the same, from the bag::

    python bench/graph/endurance.py [--minutes 60] [--priority 0] [--out out/endurance]
"""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import yaml

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Table, parser, percentiles

from tactile_base.config_paths import config_path
from tactile_records.runs.from_bag import read_arms

PERIOD, PARTS = 10.0, 6
GOAL_SECONDS = 24.0  # about: way there, path and way back


def task_file(folder: Path, minutes: float) -> Path:
    """The shipped task with its one goal on the ramp as often as the time has room for."""
    task = yaml.safe_load((config_path("tasks/surface_following.yaml")).read_text())
    goals = task["scenes"]["ramp"]["follower"]["goals"]
    count = max(1, round(60 * minutes / GOAL_SECONDS))
    repeated = [goals[0] | {"name": f"ramp_{number:03d}"} for number in range(count)]
    task["scenes"] = {"ramp": {"follower": {"goals": repeated}}}
    path = folder / "surface_following.yaml"
    path.write_text(yaml.safe_dump(task))
    return path


def look(folder: Path) -> dict[str, tuple[float, int, int]]:
    """Memory (MB), threads and descriptors by process of the run, and MB of shared memory in all."""
    found = {}
    for pid in filter(str.isdigit, os.listdir("/proc")):
        process = Path("/proc", pid)
        try:
            words = process.joinpath("cmdline").read_bytes().decode(errors="replace").split("\0")
            if str(folder) not in " ".join(words) and "tactile_ros.nodes" not in " ".join(words):
                continue
            if str(folder) not in process.joinpath("environ").read_bytes().decode(errors="replace"):
                continue
            status = dict(line.split(":", 1) for line in process.joinpath("status").read_text().splitlines())
            name = next(
                (word.rsplit(".", 1)[-1] for word in words if "tactile_ros.nodes" in word), "launcher"
            )
            memory, threads = int(status["VmRSS"].split()[0]) / 1024, int(status["Threads"])
            found[f"{name} {pid}"] = (memory, threads, len(os.listdir(process / "fd")))
        except (OSError, KeyError):  # it has ended
            continue
    shared = sum(path.stat().st_size for path in Path("/dev/shm").glob("fastdds_*"))
    return found | {"shared memory": (shared / 2**20, 0, 0)}


def table(samples: list[dict[str, tuple[float, int, int]]]) -> None:
    """Means over each part of the time, by process."""
    heads = ("process", *(f"part {n + 1}: MB, threads, descriptors" for n in range(PARTS)))
    printed = Table(heads, f"means, a look every {PERIOD:g} s", timed=True)
    parts = np.array_split(np.array(samples), PARTS)
    for name in samples[-1]:
        for_each = (np.array([look[name] for look in part if name in look]).reshape(-1, 3) for part in parts)
        printed.row(name.split()[0], *(", ".join(f"{v:.1f}" for v in one.mean(axis=0)) for one in for_each))


def latencies(bag: Path) -> None:
    """Median and p99 from exposure to command in each part, and how many goals were begun."""
    (record,) = read_arms(bag).values()
    commands = record.command.rows(record.command.exposure_ns > 0)
    first = np.unique(commands.exposure_ns, return_index=True)[1]
    ms = (commands.stamp_ns[first] - commands.exposure_ns[first]) / 1e6
    cells = ["{:.1f}, {:.1f}".format(*percentiles(part)) for part in np.array_split(ms, PARTS)]
    print("| latency p50, p99 (ms) | " + " | ".join(cells) + " |")
    print(f"\n{len(np.unique(record.command.goal))} goals, {len(ms)} beliefs acted on; {record.success=}")


def main() -> int:
    """Run, watch and tell."""
    given = parser(__doc__ or "")
    given.add_argument("--minutes", type=float, default=60.0)
    given.add_argument("--priority", type=int, default=0, help="of the nodes, as in tactile launch")
    given.add_argument("--out", type=Path, default=Path("out/endurance"))
    arguments = given.parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=False)
    task, run, bag = task_file(folder, arguments.minutes), folder / "run", folder / "bag"
    command = [sys.executable, "-m", "tactile_bringup.cli", "launch", str(task), "--scene", "ramp"]
    command += ["--headless", "--out", str(run), "--record", str(bag), "--priority", str(arguments.priority)]
    variables = os.environ | {"ENDURANCE": str(folder)}  # by which its processes are known again
    samples = []
    with (folder / "log").open("w") as log:
        launched = subprocess.Popen(command, stdout=log, stderr=log, env=variables)
        while launched.poll() is None:
            time.sleep(PERIOD)
            samples.append(look(folder))
    settled = samples[3:-3]  # neither while it starts nor while it ends
    table(settled)
    latencies(bag)
    return launched.returncode


if __name__ == "__main__":
    sys.exit(main())
