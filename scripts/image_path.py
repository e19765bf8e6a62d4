#!/usr/bin/env python3
"""Write the files that an image passes on its way to a twist, as they are called in a running task.

    . scripts/env.sh; scripts/image_path.py [TASK] [--scene SCENE] [--seconds 20]

Each node of a simulated arm runs with a profiler that is on only while a message of the chain is taken:
image, presence, estimate, state of the contact, command. What loads, reports or waits beside is left out.
"""

from __future__ import annotations

import argparse
import atexit
import os
import runpy
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from types import FrameType
from typing import Any

CHAIN = {
    "estimator": ("tactile/image",),
    "filter": ("contact/presence", "contact/estimate"),
    "controller": ("contact/state",),
    "sim": ("command/request", "arm/command/request"),  # with the stage before the simulated arm
}
FOLDER, SKIPPED = "IMAGE_PATH_FOLDER", 300  # messages of a topic after which a node does what it always does


def run_node(name: str, module: str) -> None:
    """Run one node, and write at its end which files its callbacks have passed."""
    from tactile_ros.managed_node import ManagedNode

    found: set[str] = set()
    count: dict[str, int] = {}
    subscribe = ManagedNode.subscribe

    def profile(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            found.add(frame.f_code.co_filename)

    def profiled(self: Any, kind: type, topic: str, callback: Any, *args: Any, **kwargs: Any) -> Any:
        if not topic.endswith(CHAIN[name]):
            return subscribe(self, kind, topic, callback, *args, **kwargs)

        def take(message: Any) -> None:
            count[topic] = count.get(topic, 0) + 1
            sys.setprofile(profile if count[topic] > SKIPPED else None)
            try:
                callback(message)
            finally:
                sys.setprofile(None)

        return subscribe(self, kind, topic, take, *args, **kwargs)

    def write() -> None:
        ours = {file.split("site-packages/")[-1] for file in found if "/tactile_" in file}
        files = sorted(file for file in ours if not file.startswith("tactile_msgs"))
        Path(os.environ[FOLDER], name).write_text("\n".join(files))

    ManagedNode.subscribe = profiled  # type: ignore[method-assign]
    atexit.register(write)
    sys.argv[:] = [module, *sys.argv[4:]]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def launch() -> int:
    """Run the task, its nodes by this file, and print what they have written."""
    from tactile_bringup import cli
    from tactile_bringup.graph import NodeProcess

    alone = NodeProcess.command

    def command(self: NodeProcess, parameter_file: Path, python: str = sys.executable) -> list[str]:
        given = alone(self, parameter_file, python)
        if self.name not in CHAIN:
            return given
        return [python, __file__, "--node", self.name, self.module, *given[3:]]

    NodeProcess.command = command  # type: ignore[method-assign]
    return cli.main(["launch", *sys.argv[2:], "--headless"])


def main() -> int:
    """Start the task in a process of its own, end it, and print the files by node."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("task", nargs="?", default="surface_following")
    parser.add_argument("--scene", default="plane")
    parser.add_argument("--seconds", type=float, default=20.0)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, __file__, "--launch", given.task, "--scene", given.scene, "--out", folder]
        process = subprocess.Popen(command, env={**os.environ, FOLDER: folder})
        try:
            process.wait(given.seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGINT)
            process.wait()
        passed: set[str] = set()
        for name in CHAIN:
            files = set(Path(folder, name).read_text().split())
            print(f"\n{name}, {len(files)} files", *sorted(files), sep="\n    ")
            passed |= files
    print(f"\n{len(passed)} files in all")
    return 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--node"]:
        run_node(sys.argv[2], sys.argv[3])
    elif sys.argv[1:2] == ["--launch"]:
        sys.exit(launch())
    else:
        sys.exit(main())
