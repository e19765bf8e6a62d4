"""Running nodes in a process, and how it ends: in the order in which an arm comes to rest.

A launcher or a terminal may signal all nodes at once. So the order comes from the nodes: one that moves an
arm has its task stop and leave the surface first; all others go on until nobody moves their arms any more.
A second signal ends at once, and so does the end of a node's `patience`.
"""

from __future__ import annotations

import gc
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions

from tactile_base.end_signals import signals_into
from tactile_base.raised import BY_ERROR, told
from tactile_base.settings import SettingError
from tactile_ros.discovery import use_dds_profile
from tactile_ros.managed_node import ConfigurationError, ManagedNode
from tactile_ros.scheduling import set_cores, set_priority

SPIN_TIMEOUT = 0.05  # s; how long a signal may wait while nothing else happens


def make_executor(context: Context | None = None) -> Any:
    """The executor with the least latency that this rclpy has, of a context (default: the process's)."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:  # before Kilted
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)


def run(make: Callable[[], ManagedNode | Sequence[ManagedNode]], args: list[str] | None = None) -> int:
    """Run one node, or several in one process, until a signal or an error; returns the process's exit code.

    Several start in their order and end in the opposite one; the first that stops ends them all.
    """
    try:
        use_dds_profile()
    except FileNotFoundError as error:
        print(f"cannot start: {error}", file=sys.stderr, flush=True)
        return 1
    rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    signals: list[int] = []
    signals_into(signals)
    try:
        made = make()
    except (SettingError, ConfigurationError) as error:
        print(f"cannot start: {error}", file=sys.stderr, flush=True)
        rclpy.try_shutdown()
        return 1
    nodes = [made] if isinstance(made, ManagedNode) else list(made)
    cores = {core for node in nodes for core in node.cores} - {-1}
    for missing in (set_priority(max(node.priority for node in nodes)), set_cores(cores)):
        if missing:
            nodes[-1].get_logger().warning(f"this user may not have {missing}")
    executor = make_executor()
    for node in nodes:
        executor.add_node(node)
    try:
        exit_code = _spin(nodes, executor, signals)
    finally:
        for node in reversed(nodes):
            node.rest()
        linger_time = max(node.linger_time for node in nodes)
        _spin_for(executor, linger_time)
        for node in reversed(nodes):
            node.finish()
        _spin_for(executor, 1.5 * linger_time)  # what was released with a delay of as much
        for node in nodes:
            executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()
        gc.unfreeze()
    return exit_code or next((node.exit_code for node in nodes if node.exit_code), 0)


def _spin_for(executor: Any, seconds: float) -> None:
    """Let the executor do what it still has to, such as to send a result."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.001)


def _spin(nodes: Sequence[ManagedNode], executor: Any, signals: list[int]) -> int:
    for node in nodes:
        node.warn_of_unknown_parameters()
        if node.autostart and not node.start():
            node.publish_diagnostics()
            return 1
    last = nodes[-1]
    ending: Ending | None = None
    try:
        # spin() of the events executor burns a core and dispatches nothing; spin_once in a loop does neither.
        while not any(node.stop_reason for node in nodes) and rclpy.ok():
            if signals and ending is None:
                ending = Ending(nodes, signals)
            if ending is not None and ending.over():
                break
            due = min(node.due_in() for node in nodes)
            executor.spin_once(timeout_sec=min(SPIN_TIMEOUT, max(0.0, due)))
            for node in nodes:
                if node.due_in() <= 0.0:
                    node.work()
    except ExternalShutdownException:
        last.stop("the context was shut down")
    except Exception as error:
        last.report.fault = told(error)
        last.get_logger().fatal(f"{BY_ERROR}{last.report.fault}\n{traceback.format_exc()}")
        last.publish_diagnostics()
        return 1
    ended = next((node for node in nodes if node.stop_reason), last)
    reason = f"signal {signal.Signals(signals[0]).name}" if signals else ended.stop_reason
    last.get_logger().info(f"stopping: {reason or 'the context was shut down'}")
    return ended.exit_code


class Ending:
    """From the first signal to the end of the process that runs `nodes`; `signals` goes on being filled."""

    def __init__(self, nodes: Sequence[ManagedNode], signals: Sequence[int]) -> None:
        self._nodes, self._signals = nodes, signals
        self._deadline = time.monotonic() + max(node.patience for node in nodes)
        reason = f"asked to end by {signal.Signals(signals[0]).name}"
        for node in nodes:
            node.prepare_to_end(reason)

    def over(self) -> bool:
        """Whether the process ends now; says so where it is not in order."""
        needed = next((node for node in self._nodes if node.needed()), None)
        if needed is None:
            return True
        hurry = len(self._signals) > 1
        late = time.monotonic() > self._deadline
        if hurry or late:
            why = "a second signal" if hurry else f"{needed.patience:g} s have passed"
            needed.get_logger().warning(f"{why}: ending before what the node works for has ended")
        return hurry or late
