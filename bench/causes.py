"""What a person reads when something fails in mid task: on the screen, in the result, in report.json.

    python bench/causes.py [CAUSE ...] [--task surface_following] [--scene ramp] [--after 5]

Each row of the table is a launch of real nodes on the simulated cell, recorded. So long after the
arm has begun to follow, one thing goes wrong: what the launch printed, what the report of the recording says.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import Image

from tactile_base import topics
from tactile_bringup.launching.environment import free_domain_id
from tactile_bringup.launching.operator import Operator
from tactile_ros.qos import IMAGE

CLI = [sys.executable, "-m", "tactile_bringup.cli"]
PATIENCE = 90.0  # s
ARM = "arm"


class Person(Operator):
    """Somebody at another terminal, who can do harm."""

    folder: Path

    def signal(self, node: str, number: int) -> None:
        """Send the process of a node of this launch a signal."""
        os.kill(self._process(node), number)

    def hold_up(self, node: str, seconds: float) -> None:
        """Stop the process of a node, and have it go on after a while."""
        self.signal(node, signal.SIGSTOP)
        time.sleep(seconds)
        self.signal(node, signal.SIGCONT)

    def deactivate(self, node: str) -> None:
        """Deactivate a node, as `ros2 lifecycle set` does."""
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        self._ask(ChangeState, f"/{ARM}/{node}/change_state", request)

    def show_noise(self, seconds: float) -> None:
        """Publish images that show nothing, beside the camera's."""
        publisher = self._node.create_publisher(Image, topics.IMAGE.of(ARM).name, IMAGE)
        rng = np.random.default_rng(0)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            gray = rng.integers(0, 255, (480, 640), dtype=np.uint8)
            image = Image(height=480, width=640, encoding="mono8", step=640, data=gray.tobytes())
            image.header.stamp = self._node.get_clock().now().to_msg()
            image.header.frame_id = topics.sensor_frame(ARM)
            publisher.publish(image)
            self.spin(0.015)

    def _process(self, node: str) -> int:
        """The number of a node's process: its parameters are a file of the launch's folder."""
        for entry in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                line = entry.read_bytes().decode(errors="replace")
            except OSError:  # it ended
                continue
            if f"tactile_ros.nodes.{node}_node" in line and str(self.folder) in line:
                return int(entry.parent.name)
        raise LookupError(f"no process of {node} with parameters in {self.folder}")


CAUSES: dict[str, Callable[[Person], None]] = {
    "the camera is deactivated": lambda person: person.deactivate("camera"),
    "another node publishes images of noise": lambda person: person.show_noise(2.0),
    "the estimator is killed": lambda person: person.signal("estimator", signal.SIGKILL),
    "the estimator is held up": lambda person: person.hold_up("estimator", 3.0),
    "the estimator is deactivated": lambda person: person.deactivate("estimator"),
    "the filter is killed": lambda person: person.signal("filter", signal.SIGKILL),
    "the filter is held up": lambda person: person.hold_up("filter", 3.0),
    "the filter is deactivated": lambda person: person.deactivate("filter"),
    "the controller is killed": lambda person: person.signal("controller", signal.SIGKILL),
    "the controller is held up": lambda person: person.hold_up("controller", 3.0),
    "the controller is deactivated": lambda person: person.deactivate("controller"),
    "the arm's node is deactivated": lambda person: person.deactivate("arm"),
    "the cell, arm and camera, is held up": lambda person: person.hold_up("sim", 3.0),
    "somebody stops the arm": Person.stop,
}


def show(cause: str, arguments: argparse.Namespace) -> None:
    """One row."""
    domain = free_domain_id()
    with tempfile.TemporaryDirectory() as folder, Person(domain) as person:
        person.folder = Path(folder)
        command = [
            *CLI,
            "launch",
            arguments.task,
            "--scene",
            arguments.scene,
            "--headless",
            "--priority",
            "20",
        ]
        command += ["--out", f"{folder}/run", "--record", f"{folder}/bag"]
        with Path(f"{folder}/screen").open("w") as screen:
            launch = subprocess.Popen(
                command,
                env={**os.environ, "ROS_DOMAIN_ID": str(domain)},
                stdin=subprocess.DEVNULL,
                stdout=screen,
                stderr=subprocess.STDOUT,
            )
        try:
            wait_until_at_work(person, arguments.after)
            CAUSES[cause](person)
            code = launch.wait(PATIENCE)
        finally:
            launch.kill()
        report = [*CLI, "report", f"{folder}/bag", "--out", f"{folder}/pictures"]
        subprocess.run(report, capture_output=True, check=False)
        found = next(Path(folder, "pictures").rglob("report.json"))
        values = json.loads(found.read_text())
        said = [line for line in Path(f"{folder}/screen").read_text().splitlines()[2:] if line]
        cells = cause, str(code), "<br>".join(said), values["reason"], "<br>".join(values["complaints"])
        row = " | ".join(cell.replace(folder, "...").replace("|", "/") for cell in cells)
        print(f"| {row} |", flush=True)


def wait_until_at_work(person: Person, seconds: float) -> None:
    """Until the arm's task has been at its own work for so long."""
    end, since = time.monotonic() + PATIENCE, None
    while since is None or time.monotonic() - since < seconds:
        if time.monotonic() > end:
            said = (person.folder / "screen").read_text()
            raise TimeoutError(f"the task never came to its work:\n{said}")
        person.look()
        view = person.arms.get(ARM)
        if since is None and view is not None and view.controller is not None and view.controller.at_work:
            since = time.monotonic()


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("causes", nargs="*", help=f"part of a name (default: all): {', '.join(CAUSES)}")
    parser.add_argument("--task", default="surface_following")
    parser.add_argument("--scene", default="ramp")
    parser.add_argument("--after", type=float, default=3.0, help="s (default: 3)")
    given = parser.parse_args()
    print("| cause | exit code | screen | reason in report.json | complaints in it |")
    print("| --- | --- | --- | --- | --- |")
    for cause in CAUSES:
        if not given.causes or any(part in cause for part in given.causes):
            show(cause, given)


if __name__ == "__main__":
    main()
