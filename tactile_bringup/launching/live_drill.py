"""Drill with real nodes: a task is launched, and in its midst one process or one person does harm.

The launch is that of `tactile launch`, in a process of its own; who does harm is at another terminal, so to
speak. What comes of it: what was printed, with which exit code it ended, what the report of its recording
says; and of a simulated cell also how long the arm went on, and how deep, by the cell's truth.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from sensor_msgs.msg import Image

from tactile_base import topics
from tactile_bringup.drill import DEEPEST
from tactile_bringup.graph import Graph, NodeProcess
from tactile_bringup.launching.environment import free_domain_id
from tactile_bringup.launching.operator import Operator
from tactile_bringup.timing import CLI, reported
from tactile_msgs.msg import ArmStatus, ContactTruth
from tactile_ros.qos import IMAGE, STATE
from tactile_scene.arm import AT_REST, is_at_rest

PATIENCE = 120.0  # s, for a launch to come to its work, and to end
HELD_UP = 3.0  # s
SILENCE = 0.1  # s, after which nothing is taken to have moved
LONGEST = 1.0  # s, until an arm has to rest
OURS = ("camera", "estimator", "filter", "controller", "arm")  # nodes of an arm, in the order of a message
DOUBLES = "tactile_doubles."


@dataclass
class LiveOutcome:
    """What came of one fault.

    Attributes
    ----------
    code : exit code of the launch
    rest : until the arm came to rest, s since the fault; inf: it never did. It may leave the surface after
        it. By the cell's truth, else by what the arm says; a cell that is held up stands still itself.
    deepest : of the tip since then, m, by the cell's truth; -inf where nobody knows it
    screen, complaints : list of str
        What the launch printed once it was at work; what nodes complained about, as the report has it.
    reason : why it ended, as the report has it; empty where it ended well
    """

    fault: str
    code: int = -1
    rest: float = math.inf
    deepest: float = -math.inf
    screen: list[str] = field(default_factory=list)
    reason: str = ""
    complaints: list[str] = field(default_factory=list)

    def objection(self, deepest: float = DEEPEST) -> str:
        """Why the drill is not passed; empty where it is."""
        if self.deepest > deepest:
            return f"{1e3 * self.deepest:.1f} mm deep, must stay below {1e3 * deepest:g}"
        if self.code and self.rest > LONGEST:
            return f"at rest after {self.rest:.1f} s, must be within {LONGEST:g}"
        return "" if self.code == 0 or self.reason else "it failed, and its report does not say why"


class Saboteur(Operator):
    """Somebody at another terminal, who can do harm to one arm's nodes, and sees what comes of it.

    Parameters
    ----------
    folder : of the launch: its processes are found by it
    """

    def __init__(self, domain_id: int, arm: str, folder: Path) -> None:
        super().__init__(domain_id)
        self.arm, self._folder = arm, folder
        self._since: float | None = None
        self._elapsed = 0.0  # since then, of the cell's time
        self._place: tuple[float, np.ndarray] | None = None  # of the true arm, and when it was heard
        self.outcome = LiveOutcome("")
        listen = self._node.create_subscription
        listen(ArmStatus, topics.ARM_STATUS.of(arm).name, self._see_arm, STATE)
        listen(ContactTruth, topics.TRUTH.of(arm).name, self._see_truth, STATE)

    def wait_until_at_work(self, seconds: float, ended: Callable[[], bool]) -> None:
        """Until the arm's task has been at its own work for so long; raises `TimeoutError`."""
        end, since = time.monotonic() + PATIENCE, None
        while since is None or time.monotonic() - since < seconds:
            if time.monotonic() > end or ended():
                raise TimeoutError("the task never came to its work")
            self.look()
            view = self.arms.get(self.arm)
            if since is None and view is not None and view.controller is not None and view.controller.at_work:
                since = time.monotonic()

    def begin(self, fault: str, harm: Callable[[Saboteur], None]) -> LiveOutcome:
        """Do it, from when on the outcome is watched."""
        self.outcome, self._since = LiveOutcome(fault), time.monotonic()
        harm(self)
        return self.outcome

    def conclude(self) -> None:
        """Of a cell that has fallen silent: it stood still from then on."""
        if self._place is not None:
            self.outcome.rest = min(self.outcome.rest, self._elapsed)

    def _see_arm(self, status: ArmStatus) -> None:
        if self._since is not None and self._place is None and is_at_rest(status.twist):
            self.outcome.rest = min(self.outcome.rest, time.monotonic() - self._since)

    def _see_truth(self, truth: ContactTruth) -> None:
        now, p = time.monotonic(), truth.pose.position
        before, self._place = self._place, (now, np.array([p.x, p.y, p.z]))
        if self._since is None or before is None:
            return
        passed = min(now - before[0], SILENCE)
        self._elapsed += passed
        self.outcome.deepest = max(self.outcome.deepest, truth.depth)
        if np.linalg.norm(self._place[1] - before[1]) < AT_REST[0] * passed:
            self.outcome.rest = min(self.outcome.rest, self._elapsed)

    # ---- harm ----

    def kill(self, node: NodeProcess) -> None:
        """End the process of a node, as a lack of memory does."""
        os.kill(self._process(node), signal.SIGKILL)

    def hold_up(self, pid: int) -> None:
        """Stop a process, and have it go on after a while."""
        os.kill(pid, signal.SIGSTOP)
        end = time.monotonic() + HELD_UP
        while time.monotonic() < end:
            self.look()
        os.kill(pid, signal.SIGCONT)

    def hold_up_node(self, node: NodeProcess) -> None:
        """Stop the process of a node, and have it go on after a while."""
        self.hold_up(self._process(node))

    def deactivate(self, node: str) -> None:
        """Deactivate a node, as `ros2 lifecycle set` does."""
        request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_DEACTIVATE))
        self._ask(ChangeState, f"/{self.arm}/{node}/change_state", request)

    def show_noise(self) -> None:
        """Publish images that show nothing, beside the camera's."""
        publisher = self._node.create_publisher(Image, topics.IMAGE.of(self.arm).name, IMAGE)
        rng = np.random.default_rng(0)
        end = time.monotonic() + HELD_UP
        while time.monotonic() < end:
            gray = rng.integers(0, 255, (480, 640), dtype=np.uint8)
            image = Image(height=480, width=640, encoding="mono8", step=640, data=gray.tobytes())
            image.header.stamp = self._node.get_clock().now().to_msg()
            image.header.frame_id = topics.sensor_frame(self.arm)
            publisher.publish(image)
            self.spin(0.015)

    def switch_off_arm(self) -> None:
        """End the double of the arm's controller."""
        os.kill(self._double(), signal.SIGKILL)

    def pull_arms_cable(self) -> None:
        """The double of the arm's controller says nothing for a while."""
        self.hold_up(self._double())

    def _process(self, node: NodeProcess) -> int:
        return _pid(node.module, f"__ns:={node.namespace}\0", str(self._folder))

    def _double(self) -> int:
        return _pid(DOUBLES, f"127.{self.domain_id % 250 + 1}.0.")


def _pid(*words: str) -> int:
    """The number of the process whose command line has all these words."""
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = entry.read_bytes().decode(errors="replace")
        except OSError:  # it ended
            continue
        if all(word in line for word in words):
            return int(entry.parent.name)
    raise LookupError(f"no process with {' and '.join(words)} in its command line")


def live_faults(graph: Graph, arm: str, rehearsed: bool) -> dict[str, Callable[[Saboteur], None]]:
    """All faults by name that the nodes of an arm can have, and the cell's, and of the person beside it."""
    found: dict[str, Callable[[Saboteur], None]] = {}
    processes = [node for node in graph.nodes if node.namespace == f"/{arm}" or node.name == "sim"]
    for node in sorted(processes, key=lambda node: node.name):
        found[f"{node.name} is killed"] = partial(Saboteur.kill, node=node)
        found[f"{node.name} is held up"] = partial(Saboteur.hold_up_node, node=node)
    simulated = {"arm", "camera"} if any(node.name == "sim" for node in processes) else set()
    own = {node.name for node in processes} | simulated
    for name in OURS:
        if name in own and ("estimator" in own or name != "camera"):
            found[f"{name} is deactivated"] = partial(Saboteur.deactivate, node=name)
    if "estimator" in own:
        found["another node publishes images of noise"] = Saboteur.show_noise
    if rehearsed:
        found["the arm is switched off"] = Saboteur.switch_off_arm
        found["the arm's cable is out for a while"] = Saboteur.pull_arms_cable
    found["somebody stops the arm"] = Saboteur.stop
    return found


def drill_live(
    fault: str, harm: Callable[[Saboteur], None], arm: str, launch: Sequence[str], folder: Path, after: float
) -> LiveOutcome:
    """Launch, do harm after so many seconds (s) of work, and wait for the end.

    Parameters
    ----------
    launch : arguments of `tactile launch`: the task and its options
    folder : a new one, for run, recording and report

    Raises `TimeoutError` if the launch does not come to its work, or does not end.
    """
    domain = free_domain_id()
    command = [*CLI, "launch", *launch, "--headless", "--out", f"{folder}/run", "--record", f"{folder}/bag"]
    folder.mkdir(parents=True)
    screen = folder / "screen.txt"
    with screen.open("w") as output, Saboteur(domain, arm, folder) as person:
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain)}
        process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT
        )
        try:
            person.wait_until_at_work(after, lambda: process.poll() is not None)
            before = len(_lines(screen))
            outcome = person.begin(fault, harm)
            end = time.monotonic() + PATIENCE
            while process.poll() is None and time.monotonic() < end:
                person.look()
            outcome.code = process.wait(0.0) if process.poll() is not None else -1
            person.conclude()
        except TimeoutError as error:
            raise TimeoutError(f"{error}:\n{screen.read_text()}") from error
        finally:
            process.terminate()
            process.wait()
    outcome.screen, report = _lines(screen)[before:], reported(folder)
    outcome.reason, outcome.complaints = report.get("reason", ""), report.get("complaints", [])
    return outcome


def _lines(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if line]
