"""Starts the processes of a graph, runs the task, and brings everything to rest again, whatever happens.

Order of an end by Ctrl-C, SIGTERM or failure: the task is cancelled, so the arm stops and leaves the surface;
when the arm rests, or after `REST_TIMEOUT`, the nodes get SIGINT, then SIGTERM, then SIGKILL; the recorder
last, so that the bag holds the end as well; then shared memory that a killed node left is removed. A second
signal does not wait for the arm (its driver stops it when commands end), a third kills.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from tactile_bringup import shared_memory
from tactile_bringup.environment import RosEnvironment, ros_environment
from tactile_bringup.graph import RECORDER, Graph, NodeProcess
from tactile_bringup.processes import ProcessDied, ProcessGroup
from tactile_bringup.progress import Display
from tactile_control.task import PathGoal

if TYPE_CHECKING:
    from tactile_bringup.task_client import PathResult, TaskClient

EXIT_OK, EXIT_TASK_FAILED, EXIT_USAGE, EXIT_NODE_DIED, EXIT_NOT_READY = 0, 1, 2, 3, 4
EXIT_SIGNAL = 128  # plus the signal's number

READY_TIMEOUT = 45.0  # s from start until all nodes are active
REST_TIMEOUT = 6.0  # s for a cancelled task to bring the arm to rest
SPIN = 0.05  # s between looks at signals and processes while nothing arrives


class NotReady(RuntimeError):
    """Nodes that did not become active in time."""


class Interrupted(RuntimeError):
    """SIGINT or SIGTERM was sent to the launcher."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(f"stopped by {signal.Signals(number).name}")


@dataclass
class Outcome:
    """How a launch ended.

    Attributes
    ----------
    exit_code : int
        0 done, 1 task failed, 3 a node died, 4 not ready in time, 128 + n ended by signal n.
    reason : str
        In words; empty when all went well.
    paths : list of PathResult
        Those that ended.
    logs : Path
        Folder with one log a node.
    at_rest : bool or None
        Whether every arm reported rest before its driver was stopped; None where none had reported at all.
    escalated : list of str
        Nodes that did not end by SIGINT alone, and what it took.
    """

    exit_code: int
    reason: str
    logs: Path
    paths: list[PathResult] = field(default_factory=list)
    at_rest: bool | None = None
    escalated: list[str] = field(default_factory=list)


class Launcher:
    """One run of a graph; `run` does it all.

    Parameters
    ----------
    graph : Graph
        What to start.
    paths : sequence of PathGoal
        Run one after the other, on every arm of the graph at the same time.
    folder : Path
        For logs and parameter files.
    display : Display
        Shows progress.
    """

    def __init__(self, graph: Graph, paths: Sequence[PathGoal], folder: Path, display: Display) -> None:
        self.graph, self.paths, self.display = graph, paths, display
        self.logs = folder / "logs"
        self._parameters = folder / "parameters"
        self._environment = ros_environment(self.logs / "ros")
        self._signals: list[int] = []
        self._client: TaskClient | None = None
        self._group: ProcessGroup | None = None

    def run(self) -> Outcome:
        """Start, run the paths, stop. Never raises for what happens to nodes or task."""
        outcome = Outcome(EXIT_OK, "", self.logs)
        shared_memory.remove_orphans()  # a port file left by the dead would be taken over with its old state
        started_ns = time.time_ns()
        with _signals_into(self._signals), ProcessGroup() as self._group:
            try:
                self._start()
                self._wait_until_active()
                self._run_paths(outcome)
            except ProcessDied as death:
                outcome.exit_code, outcome.reason = EXIT_NODE_DIED, f"node {death}"
            except NotReady as late:
                outcome.exit_code, outcome.reason = EXIT_NOT_READY, str(late)
            except Interrupted as interrupt:
                outcome.exit_code, outcome.reason = EXIT_SIGNAL + interrupt.number, str(interrupt)
                self.display.say(f"{interrupt}: bringing the arm to rest (again to hurry)", "yellow")
            finally:
                self._stop(outcome)
        shared_memory.remove_orphans(started_ns)
        return outcome

    def _start(self) -> None:
        environment = self._environment
        _adopt(environment)
        chosen = "chosen" if environment.domain_chosen else "as set"
        self.display.say(
            f"{self.graph.task} on scene {self.graph.scene}: {len(self.graph.nodes)} nodes, "
            f"ROS domain {environment.domain_id} ({chosen}), discovery {environment.discovery_range}, "
            f"logs in {self.logs}"
        )
        for node in self.graph.nodes:
            self._start_node(node)
        from tactile_bringup.task_client import TaskClient  # ROS reads the environment when it is loaded

        self._client = TaskClient(environment.domain_id)

    def _start_node(self, node: NodeProcess) -> None:
        assert self._group is not None
        self._parameters.mkdir(parents=True, exist_ok=True)
        file = self._parameters / f"{node.file_stem}.yaml"
        file.write_text(node.parameter_text())
        log = self.logs / f"{node.file_stem}.log"
        self._group.start(node.full_name, node.command(file), self._environment.variables, log)

    def _wait_until_active(self) -> None:
        assert self._client is not None
        client, names = self._client, [node.full_name for node in self.graph.nodes]
        started = time.monotonic()
        while True:
            now = time.monotonic()
            waiting = client.inactive(names, now)
            waiting |= {f"/{a}/run_task": "no server yet" for a in self.graph.arms if not client.arm(a).ready}
            if not waiting:
                break
            if now - started > READY_TIMEOUT:
                states = ", ".join(f"{name} ({state})" for name, state in waiting.items())
                raise NotReady(
                    f"not active {READY_TIMEOUT:.0f} s after the start: {states}; logs: {self.logs}"
                )
            self._turn()
        self.display.say(f"all nodes active after {time.monotonic() - started:.1f} s")

    def _run_paths(self, outcome: Outcome) -> None:
        for number, path in enumerate(self.paths, 1):
            label = f"[{number}/{len(self.paths)}] {path.name}"
            results = self._run_path(path, label)
            outcome.paths += results
            failed = [result for result in results if not result.success]
            for result in results:
                verdict = "done" if result.success else f"failed: {result.reason}"
                self.display.say(
                    f"{label}: {verdict} ({1e3 * result.length:.0f} mm in {result.duration_s:.1f} s)",
                    "red" if failed else "green",
                )
            if failed:
                outcome.exit_code = EXIT_TASK_FAILED
                outcome.reason = f"path {path.name}: {failed[0].reason}"
                return

    def _run_path(self, path: PathGoal, label: str) -> list[PathResult]:
        assert self._client is not None
        tasks = {arm: self._client.arm(arm) for arm in self.graph.arms}
        for task in tasks.values():
            task.send(path, self.graph.task)
        results: dict[str, PathResult] = {}
        while len(results) < len(tasks):
            self._turn()
            self.display.update(label, {arm: task.progress for arm, task in tasks.items()})
            for arm, task in tasks.items():
                result = task.result()
                if result is not None:
                    results[arm] = result
        return list(results.values())

    def _turn(self) -> None:
        """Handle messages, then look at signals and processes."""
        assert self._client is not None and self._group is not None
        self._client.spin(SPIN)
        if self._signals:
            raise Interrupted(self._signals[0])
        self._group.check()

    def _stop(self, outcome: Outcome) -> None:
        """Task, arm, nodes, recorder: in this order."""
        assert self._group is not None
        if self._client is not None:
            outcome.at_rest = self._bring_to_rest()
            self._client.close()
        nodes = [name for name in self._group.children if name != f"/{RECORDER}"]
        urgent = len(self._signals) > 2
        reports = self._group.stop(nodes, urgent) + self._group.stop(urgent=urgent)
        outcome.escalated = [f"{r.name} took {r.escalated_to}" for r in reports if r.escalated_to]
        for line in outcome.escalated:
            self.display.say(f"{line} to end", "yellow")

    def _bring_to_rest(self) -> bool | None:
        """Cancel what runs and wait until every arm that still speaks rests."""
        assert self._client is not None
        tasks = [self._client.arm(arm) for arm in self.graph.arms]
        patience = len(self._signals) + 1
        for task in tasks:
            task.cancel()
        if all(task.progress.arm_mode is None for task in tasks):
            return None
        deadline = time.monotonic() + REST_TIMEOUT
        rest = False
        while not rest and time.monotonic() < deadline and len(self._signals) < patience:
            self._client.spin(SPIN)
            ended = [task.result() is not None or not task.running for task in tasks]
            rest = all(ended) and all(task.at_rest for task in tasks)
        return all(task.at_rest for task in tasks)


def _adopt(environment: RosEnvironment) -> None:
    """Take over what ROS in this process reads from the environment."""
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR", "ROS_DOMAIN_ID"):
        os.environ[name] = environment.variables[name]


@contextmanager
def _signals_into(received: list[int]) -> Iterator[None]:
    """Collect SIGINT and SIGTERM instead of dying by them."""

    def collect(number: int, frame: FrameType | None) -> None:
        received.append(number)

    before: dict[int, Callable[[int, FrameType | None], object] | int | None] = {
        number: signal.signal(number, collect) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
