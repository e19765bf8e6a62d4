"""How many files and how much address space the processes of a task take: `tactile_base/process_limits.py`.

    python bench/graph/process_needs.py [TASK]

The task runs with all that can be asked for (recording with images, view of the markers, belief over the
object), and each process of it is looked at twenty times a second until it ends.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import parser

PERIOD = 0.05  # s


def main() -> int:
    """Print the most that each process has taken."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("task", nargs="?", default="surface_following")
    task = arguments.parse_args().task
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "tactile_bringup.cli", "launch", task, "--headless", "--out", folder]
        command += ["--record", f"{folder}/bag", "--record-images", "--marker-view", "--object-belief"]
        launch = subprocess.Popen(command)
        most: dict[str, tuple[int, int, int]] = {}
        while launch.poll() is None:
            for process in Path("/proc").glob("[0-9]*"):
                look(process, folder, most)
            time.sleep(PERIOD)
    print(f"{os.cpu_count()} cores; {'process':40} files  address space (MB)  threads")
    for name, (files, space, threads) in sorted(most.items()):
        print(f"{name:50} {files:5} {space / 1e6:12.0f} {threads:14}")
    return launch.returncode


def look(process: Path, folder: str, most: dict[str, tuple[int, int, int]]) -> None:
    """Note what a process takes, if it is one of the launch in that folder."""
    try:
        words = (process / "cmdline").read_text().split("\0")
        if not any(folder in word for word in words):
            return
        status = dict(re.findall(r"(\w+):\s+(\d+)", (process / "status").read_text()))
        now = len(os.listdir(process / "fd")), int(status["VmPeak"]) * 1024, int(status["Threads"])
    except (OSError, KeyError):  # it has ended
        return
    name = Path(next((word for word in words if word.endswith(".yaml")), "launcher")).stem
    before = most.get(name, now)
    most[name] = max(now[0], before[0]), max(now[1], before[1]), max(now[2], before[2])


if __name__ == "__main__":
    sys.exit(main())
