"""Starts the processes of a graph, runs the task, and brings everything to rest again, whatever happens.

Order of an end by Ctrl-C, SIGTERM or failure: the task is cancelled, so the arm stops and leaves the surface;
when the arm rests, or after `REST_TIMEOUT`, the nodes get SIGINT, then SIGTERM, then SIGKILL; the recorder
last, so that the bag holds the end as well; then shared memory that a killed node left is removed. A second
signal does not wait for the arm (its driver stops it when commands end), a third kills. Signals are collected
until the last word has been said, which tells of the arm.
"""

from __future__ import annotations

import contextlib
import os
import signal
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_bringup.graph import RECORDER, Graph, NodeProcess
from tactile_bringup.launching import shared_memory
from tactile_bringup.launching.environment import ros_environment
from tactile_bringup.launching.page_process import served_page
from tactile_bringup.launching.processes import ProcessDied, ProcessGroup, Stopped
from tactile_bringup.launching.progress import Display
from tactile_bringup.launching.start_check import check_start
from tactile_bringup.launching.task_runner import (
    RESTS,
    Interrupted,
    NotReady,
    TaskRunner,
    Unfinished,
    collecting_signals,
    in_disorder,
)

if TYPE_CHECKING:
    from tactile_bringup.launching.task_client import GoalResult

EXIT_REFUSED, EXIT_NODE_DIED = 2, 3
NAMESAKE_TIMEOUT = 20.0  # s for another launch to end: what its arms and its nodes may take


@dataclass
class Outcome:
    """How a launch ended.

    Attributes
    ----------
    exit_code : 0 done, 1 task failed, 2 not started, 3 a node died, 4 not ready in time, 5 done or ended by a
        signal, but not in order, 128 + n ended by signal n
    reason : in words; empty when all went well
    goals : those that ended
    logs : folder with one log a node
    overload : what to do about a machine that was overloaded shortly before the end; empty for others
    at_rest : bool or None
        Whether every arm reported rest before its driver was stopped; None where none had reported at all.
    escalated : nodes that did not end by SIGINT alone, and what it took
    """

    exit_code: int
    reason: str
    logs: Path
    overload: str = ""
    goals: list[GoalResult] = field(default_factory=list)
    at_rest: bool | None = None
    escalated: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Manner:
    """How a graph is launched.

    Attributes
    ----------
    command : what the user has called, for messages
    headless : whether there is no live display
    waits : whether it runs no goal, but waits for its end while they come from elsewhere
    view : whether the page in the browser is served beside it; what becomes of that does not matter
    """

    command: str = "launch"
    headless: bool = False
    waits: bool = False
    view: bool = False


class Launcher:
    """One run of a graph; `run` does it all.

    Parameters
    ----------
    graph : what to start, and what its arms do
    folder : for logs and parameter files
    display : shows progress, and how it ended
    manner : how
    """

    def __init__(self, graph: Graph, folder: Path, display: Display, manner: Manner | None = None) -> None:
        self.graph, self.display, self.manner = graph, display, manner or Manner()
        self.logs = folder / "logs"
        self._parameters = folder / "parameters"
        self._signals: list[int] = []
        self._runner: TaskRunner | None = None
        self._worked = False  # whether all nodes have been active

    def run(self) -> Outcome:
        """Check, start, run the goals, stop, say how it ended.

        Never raises for what happens to nodes or task.
        """
        outcome = Outcome(0, "", self.logs)
        with collecting_signals(self._signals):
            try:
                check_start(self.graph)
                self._environment = ros_environment(self.logs / "ros")
            except (ValueError, RuntimeError) as fault:  # what cannot be started, or no ROS domain
                outcome.exit_code, outcome.reason = EXIT_REFUSED, str(fault)
            else:
                self._run_processes(outcome)
            self._tell(outcome)
        return outcome

    def end(self) -> None:
        """Have `run` end in order, as by Ctrl-C; from another thread."""
        self._signals.append(signal.SIGINT)

    def _run_processes(self, outcome: Outcome) -> None:
        shared_memory.remove_orphans()  # a port file left by the dead would be taken over with its old state
        started_ns, dead = time.time_ns(), ""
        with ProcessGroup() as group, contextlib.ExitStack() as beside:
            try:
                self._run_task(group, beside)
            except ProcessDied as death:
                outcome.exit_code, outcome.reason, dead = EXIT_NODE_DIED, f"node {death}", death.name
            except Unfinished as end:
                outcome.exit_code, outcome.reason = end.exit_code, str(end)
                if isinstance(end, Interrupted):
                    self.display.say(f"{end}: bringing the arm to rest (again to hurry)", "yellow")
            finally:
                if self._runner is not None:
                    self._note(self._runner, outcome)
                reports = self._stop(group, outcome)
            self._judge([report for report in reports if report.name != dead], outcome)
        shared_memory.remove_orphans(started_ns)

    def _note(self, runner: TaskRunner, outcome: Outcome) -> None:
        """Have the recording know what the nodes do not; their start alone keeps all cores busy."""
        if self._worked or outcome.exit_code == NotReady.exit_code:
            outcome.overload = runner.cores.overload()
        for text in filter(None, (outcome.overload, outcome.reason)):
            runner.client.note(text)

    def _run_task(self, group: ProcessGroup, beside: contextlib.ExitStack) -> None:
        environment = self._environment
        for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_LOG_DIR", "ROS_DOMAIN_ID"):
            os.environ[name] = environment.variables[name]  # what ROS in this process reads
        chosen = "chosen" if environment.domain_chosen else "as set"
        self.display.say(
            f"{self.graph.task} on scene {self.graph.scene}: {len(self.graph.nodes)} nodes, "
            f"ROS domain {environment.domain_id} ({chosen}), discovery {environment.discovery}, "
            f"logs in {self.logs}"
        )
        for remark in self.graph.remarks:
            self.display.say(remark, "yellow")
        if environment.shared:
            self._wait_for_namesakes(group)
        for node in self.graph.nodes:
            self._start_node(group, node)
        self._runner = self._connect(group)
        self._runner.wait_until_active()
        self._worked = True
        if self.manner.view:
            page = beside.enter_context(served_page(self._environment.variables, self.logs / "view.log"))
            self.display.say(f"page: {page.address}, in a few seconds")
        if self.manner.waits:
            self._runner.wait()
        self._runner.run()

    def _wait_for_namesakes(self, group: ProcessGroup) -> None:
        """Until no node of another launch has the name of one that is to be started; raises `NotReady`.

        A launch that ends is waited for. Beside one that goes on, two nodes would answer as one: ours would
        count as active before it is, and obey commands meant for the other. Each look is that of a fresh
        participant, which does not know the dead.
        """
        started, told = time.monotonic(), False
        while namesakes := self._namesakes(group):
            if time.monotonic() - started > NAMESAKE_TIMEOUT:
                raise NotReady(
                    f"nodes of these names run in this ROS domain already: {namesakes}; end them, or set "
                    "another ROS_DOMAIN_ID"
                )
            if not told:
                self.display.say(f"waiting for another launch to end: {namesakes}", "yellow")
            told = True

    def _namesakes(self, group: ProcessGroup) -> str:
        runner = self._connect(group)
        try:
            return ", ".join(sorted(runner.namesakes()))
        finally:
            runner.client.close()

    def _connect(self, group: ProcessGroup) -> TaskRunner:
        # here, since ROS reads the environment when it is loaded
        from tactile_bringup.launching.task_client import TaskClient

        names = [node.full_name for node in self.graph.nodes]
        client = TaskClient(self._environment.domain_id)
        return TaskRunner(client, names, self.graph.plans, self.display, self._signals, group.check)

    def _start_node(self, group: ProcessGroup, node: NodeProcess) -> None:
        self._parameters.mkdir(parents=True, exist_ok=True)
        file = self._parameters / f"{node.file_stem}.yaml"
        file.write_text(node.parameter_text())
        log = self.logs / f"{node.file_stem}.log"
        group.start(node.full_name, node.command(file), self._environment.variables, log)

    def _stop(self, group: ProcessGroup, outcome: Outcome) -> list[Stopped]:
        """Task, arm, nodes, recorder: in this order."""
        recorder = f"/{RECORDER}"
        if self._runner is not None:
            outcome.at_rest = self._runner.bring_to_rest()
            outcome.goals = self._runner.results
            if recorder in group.children:
                process = group.children[recorder].process
                self._runner.wait_for_recorder(recorder, lambda: process.poll() is None)
            self._runner.client.close()
        nodes = [name for name in group.children if name != recorder]
        urgent = len(self._signals) > 2
        reports = group.stop(nodes, urgent) + group.stop(urgent=urgent)
        outcome.escalated = [f"{r.name} took {r.escalated_to}" for r in reports if r.escalated_to]
        for line in outcome.escalated:
            self.display.say(f"{line} to end", "yellow")
        return reports

    def _judge(self, reports: list[Stopped], outcome: Outcome) -> None:
        """What did not end in order counts, unless somebody was in a hurry and wanted it so."""
        hurried = len(self._signals) > 1
        bad = [r for r in reports if r.exit_code and not (hurried and r.exit_code == -signal.SIGKILL)]
        disorder = [f"while everything was stopped: node {report}" for report in bad if self._worked]
        if outcome.at_rest is False and not hurried:
            disorder.append("not every arm was seen at rest")
        if not disorder:
            return
        if outcome.exit_code == 0:
            outcome.reason = "the task was done, but not all has ended in order"
        outcome.exit_code = in_disorder(outcome.exit_code)
        outcome.reason = "\n".join([outcome.reason, *disorder])

    def _tell(self, outcome: Outcome) -> None:
        if outcome.overload:
            self.display.say(f"note: {outcome.overload}", "yellow")
        if outcome.reason:
            self.display.say(f"tactile {self.manner.command}: {outcome.reason}", "red")
        refused = outcome.exit_code == EXIT_REFUSED
        ended = f"stopped: {RESTS[outcome.at_rest]}; logs: {outcome.logs}"
        self.display.say("nothing was started" if refused else ended)
