"""Runs a task on nodes: waits until they are active, sends goals, brings the arms to rest."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, NoReturn

from tactile_base.end_signals import signals_into
from tactile_base.process_limits import CoreWatch
from tactile_base.topics import RUN_TASK
from tactile_bringup.launching.progress import Display
from tactile_bringup.run_sequence import ArmPlan, RunSequence
from tactile_drivers.arm_watch import DOES_NOT_STOP

if TYPE_CHECKING:
    from tactile_bringup.launching.task_client import ArmTask, GoalResult, TaskClient

HEARD = 4.0  # s in which every node is heard of: one announces itself every 3 s (config/dds/)
READY_TIMEOUT = 45.0  # s until all nodes are active
REST_TIMEOUT = 12.0  # s for a cancelled task to bring the arm to rest; `contact.retreat_timeout` is 10
REGULAR = 0.5  # s of regular reports before the first goal starts
SETTLE_TIMEOUT = 5.0  # s after which it starts all the same
GONE = 2.0  # s without a word from an arm, which may be held up, after which its driver counts as ended
SETTLED = 0.5  # s of rest that count as the end of a goal whose result does not come
HELD_UP = 0.5  # s without an answer after which a node counts as held up
HOLD_TIMEOUT = 30.0  # s that one is waited for: what nodes keep of what they have published (`qos.RECORDED`)
CATCH_UP = 5.0  # s for one that was held up to take from its publishers what it has missed, and to know it
SPIN = 0.05  # s between looks at signals and processes while nothing arrives
#: What `TaskRunner.bring_to_rest` returns, in words.
RESTS = {True: "the arm rests", False: "the arm did not report rest in time", None: "the arm never reported"}


class Unfinished(RuntimeError):
    """A run that came to no good end; `exit_code` is what the command ends with."""

    exit_code: int


class NotReady(Unfinished):
    """Nodes that did not become active in time."""

    exit_code = 4


class Interrupted(Unfinished):
    """SIGINT, SIGTERM or, by a terminal that was closed, SIGHUP was sent to this process."""

    def __init__(self, number: int) -> None:
        self.exit_code = 128 + number
        super().__init__(f"stopped by {signal.Signals(number).name}")


class GoalFailed(Unfinished):
    """A goal that was not reached."""

    exit_code = 1


EXIT_DISORDER = 5


def in_disorder(exit_code: int) -> int:
    """The exit code of what was done, or ended by a signal, but not in order; that of a failure stays."""
    return EXIT_DISORDER if exit_code == 0 or exit_code > 128 else exit_code


class Label(NamedTuple):
    """A goal for people, and whether it is reached some time without being asked to end."""

    text: str
    ends: bool


@dataclass
class TaskRunner:
    """Drives the arms of one graph through `client`.

    Attributes
    ----------
    nodes : full names of the managed nodes that have to be active
    plans : what each arm does
    signals : signals received so far (see `collecting_signals`)
    check : called often; raises to end the run
    results : of the goals that have ended
    cores : whether the machine is overloaded
    """

    client: TaskClient
    nodes: Sequence[str]
    plans: Sequence[ArmPlan]
    display: Display
    signals: list[int]
    check: Callable[[], None] = lambda: None
    results: list[GoalResult] = field(default_factory=list)
    _alarmed: set[str] = field(default_factory=set)
    cores: CoreWatch = field(default_factory=CoreWatch)

    @property
    def arms(self) -> list[str]:
        """The arms that do something."""
        return [plan.arm for plan in self.plans]

    def namesakes(self) -> set[str]:
        """Nodes of others with names of ours, which have not been started; listens for `HEARD`."""
        end = time.monotonic() + HEARD
        while not (found := self.client.node_names() & set(self.nodes)) and time.monotonic() < end:
            self._turn()
        return found

    def wait_until_active(self, timeout_s: float | None = None) -> None:
        """Until all nodes are active and take goals; raises `NotReady` with the state of the others."""
        limit = READY_TIMEOUT if timeout_s is None else timeout_s
        started = time.monotonic()
        while waiting := self._waiting():
            if time.monotonic() - started > limit:
                states = ", ".join(f"{name} ({state})" for name, state in waiting.items())
                raise NotReady(f"not active after {limit:.0f} s: {states}")
            self._turn()
        self.display.say(f"all nodes active after {time.monotonic() - started:.1f} s")
        self._let_settle()

    def _let_settle(self) -> None:
        """Until the arms report regularly: what nodes do only at their start holds up a small machine."""
        deadline = time.monotonic() + SETTLE_TIMEOUT
        while time.monotonic() < deadline:
            if all(self.client.arm(arm).regular_for > REGULAR for arm in self.arms):
                return
            self._turn()
        why = self.cores.overload() or "is the machine busy with something else?"
        self.display.say(f"the arms do not report regularly: {why}", "yellow")

    def wait(self) -> NoReturn:
        """Run no goal: they come from elsewhere, until somebody ends it."""
        self.display.say("waiting for goals of others, as `tactile goal` and `tactile run` send; Ctrl-C ends")
        while True:
            self._turn()

    def run(self) -> None:
        """Run all goals as `RunSequence` has it; raises `GoalFailed` if one is not reached."""
        sequence = RunSequence(self.plans)
        labels: dict[str, Label] = {}
        while not sequence.finished:
            for plan, number in sequence.start():
                goal = plan.goals[number]
                text = f"[{number + 1}/{len(plan.goals)}] {goal.name}"
                labels[plan.arm] = Label(text, goal.goal.ends)
                self.client.arm(plan.arm).send(goal, plan.role.task)
            for arm in sequence.finish():
                self.client.arm(arm).cancel()
            self._turn()
            self._follow(sequence, labels)
        if sequence.failure:
            raise GoalFailed(sequence.failure)

    def _follow(self, sequence: RunSequence, labels: dict[str, Label]) -> None:
        running = {
            plan.arm: (labels[plan.arm], self.client.arm(plan.arm))
            for plan in self.plans
            if sequence.running(plan.arm)
        }
        for arm, (label, task) in running.items():
            self.display.show(arm, label.text, task.progress, label.ends)
            sequence.phase(arm, task.progress.phase)
            result = task.result()
            if result is not None:
                well = sequence.result(arm, result.success, result.reason)
                self._conclude(label.text, arm, result, well)

    def _conclude(self, label: str, arm: str, result: GoalResult, well: bool) -> None:
        self.results.append(result)
        self.display.conclude(arm, label)
        verdict = "done" if well else f"failed: {result.reason}"
        length = f"{1e3 * result.length:.0f} mm in {result.duration_s:.1f} s"
        name = f"{arm}: {label}" if len(self.plans) > 1 else label
        self.display.say(f"{name}: {verdict} ({length})", "green" if well else "red")

    def bring_to_rest(self) -> bool | None:
        """Cancel what runs and wait until every arm rests, a further signal comes, or `REST_TIMEOUT`.

        Returns
        -------
        bool or None
            Whether every arm rests; None where no arm has ever said anything.
        """
        tasks = [self.client.arm(arm) for arm in self.arms]
        patience = len(self.signals) + 1
        for task in tasks:
            task.cancel()
        if all(task.progress.arm_mode is None for task in tasks):
            return None
        started = time.monotonic()
        while time.monotonic() - started < REST_TIMEOUT and len(self.signals) < patience:
            self._spin()
            listened = time.monotonic() - started > GONE
            if all(_settled(task) or (listened and task.silence_duration > GONE) for task in tasks):
                break
        moving = [task for task in tasks if task.rests_for() == 0.0]
        for task in moving:
            self.display.say(f"{task.arm} was not seen at rest: {task.last_word()}", "yellow")
        return not moving

    def wait_for_recorder(self, name: str, lives: Callable[[], bool]) -> None:
        """Until a recorder that is held up has what was published: it goes with the nodes that published it.

        Ends as well when a further signal comes, the recorder no longer `lives`, or after `HOLD_TIMEOUT`.
        """
        if not self.client.ask_again(name):
            return
        patience = len(self.signals) + 1
        started, held_up, limit = time.monotonic(), False, HOLD_TIMEOUT
        while time.monotonic() - started < limit and len(self.signals) < patience and lives():
            self._spin()
            waited = time.monotonic() - started
            if limit == HOLD_TIMEOUT and not self.client.inactive([name], time.monotonic()):
                limit = waited + CATCH_UP if held_up else 0.0
            elif waited > HELD_UP and not held_up:
                held_up = True
                self.display.say("the recorder is held up: waiting for it (Ctrl-C: not any longer)", "yellow")

    def _waiting(self) -> dict[str, str]:
        inactive = self.client.inactive(list(self.nodes), time.monotonic())
        deaf = {f"/{a}/{RUN_TASK}": "no action server" for a in self.arms if not self.client.arm(a).ready}
        return inactive | deaf

    def _spin(self) -> None:
        """Handle messages, and the key that stops all arms; an arm that does not stop is told at once."""
        self.client.spin(SPIN)
        for arm in self.arms:
            reason = self.client.arm(arm).progress.arm_reason
            if reason.startswith(DOES_NOT_STOP) and arm not in self._alarmed:
                self._alarmed.add(arm)
                self.display.say(f"{arm}: {reason}", "red")
        self.cores.look()
        if self.display.stop_wanted():
            self.client.stop_arms()
            self.display.say("a key was pressed: emergency stop of all arms", "red")

    def _turn(self) -> None:
        """Handle messages and keys, then look at signals and processes."""
        self._spin()
        if self.signals:
            raise Interrupted(self.signals[0])
        self.check()


def _settled(task: ArmTask) -> bool:
    """Whether the arm rests and its goal has ended.

    Where a controller has died its goal never ends; the arm then only has to stay at rest for a while.
    """
    ended = not task.running or task.result() is not None
    return task.rests_for() > (0.0 if ended else SETTLED)


@contextmanager
def collecting_signals(received: list[int]) -> Iterator[None]:
    """Collect requests to end, as `signals_into` does, for a while."""
    before = signals_into(received)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
