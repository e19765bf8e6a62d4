"""`tactile reset`, `status`, `reference`, `get`, `set`, `goal`, `cancel`: by hand beside a graph.

They speak to the nodes of the ROS domain that ROS_DOMAIN_ID names; where it is not set, to that of the arms
which run on this host, as their stop lines tell.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rich.console import Console

from tactile_base.console import lasting_console, say
from tactile_base.settings import unknown_name
from tactile_base.stop_line import arms_here
from tactile_base.yaml_file import name_and_value, value_text
from tactile_bringup.commands import COMMANDS
from tactile_bringup.commands.changes import add_command

if TYPE_CHECKING:
    from tactile_bringup.launching.operator import ArmView, Operator

FIND = 5.0  # s, at most, to find what is there; less where all that was found has spoken
EXAMPLE = "pid.kp='[0, 0, 3, 2, 2, 0]'"


def register(subparsers: Any) -> None:
    acts = {"reset": _reset, "reference": _reference, "cancel": _cancel, "status": _status}
    for name, act in acts.items():
        add = _add(subparsers, name, act)
        add("arms", nargs="*", metavar="ARM", help="(default: all that can)")
    add("--watch", action="store_true", help="again every second, until Ctrl-C")
    add = _add(subparsers, "get", _get)
    add("node", nargs="?", metavar="NODE", help="as /arm/controller (default: list the nodes)")
    add("name", nargs="?", metavar="NAME", default="", help="one, or all that begin so")
    add = _add(subparsers, "set", _set)
    add("node", metavar="NODE", help="as /arm/controller")
    add("changes", nargs="+", metavar="NAME=VALUE", help=f"as {EXAMPLE}")
    add = _add(subparsers, "goal", _goal)
    text = "its values, as '{direction_deg: 90, length: 0.05}' (default: those of the task)"
    add("goal", nargs="?", default="{}", metavar="YAML", help=text)
    add("--arm", default="", metavar="ARM", help="(default: the only one)")
    add("--name", default="by hand", help="how it is called in status and reports")
    add("--settings", default="", metavar="YAML", help="settings of the task for this goal alone")


def _add(subparsers: Any, name: str, act: Callable[[argparse.Namespace, Operator, Console], int]) -> Any:
    def run(arguments: argparse.Namespace) -> int:
        from tactile_bringup.launching.operator import Operator

        with Operator(chosen_domain()) as operator:
            return act(arguments, operator, lasting_console())

    about = f"{COMMANDS[name][1]}."
    return add_command(subparsers, name, run, about, status=1, wrong=(RuntimeError,)).add_argument


def chosen_domain() -> int:
    """The ROS domain to look at; `ValueError` where arms run in several."""
    given = os.environ.get("ROS_DOMAIN_ID", "")
    if given:
        return int(given)
    found: dict[int, list[str]] = {}
    for word in arms_here():
        found.setdefault(word.domain, []).append(word.arm)
    if len(found) > 1:
        listed = "; ".join(f"{domain}: {', '.join(arms)}" for domain, arms in sorted(found.items()))
        raise ValueError(f"arms run in several ROS domains ({listed}): set ROS_DOMAIN_ID to one of them")
    return next(iter(found), 0)


# ---- arms ----


def _reset(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    from tactile_bringup.launching.operator import OperatorError

    failed = 0
    for view in _arms(arguments.arms, operator):
        try:
            say(console, f"/{view.name}: {operator.reset(view.name)}")
        except OperatorError as error:
            failed = 1
            say(console, f"/{view.name} was not reset: {error}", "red")
    return failed


def _reference(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    views = _arms(arguments.arms, operator)
    if not arguments.arms:
        views = [view for view in views if f"/{view.name}/estimator" in operator.node_names()]
    for view in views:
        say(console, f"/{view.name}: {operator.capture_reference(view.name)}")
    if not views:
        say(console, "no arm has an estimator")
    return int(not views)


def _cancel(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    _find_controllers(operator)
    for view in operator.chosen(arguments.arms):
        count = operator.cancel(view.name) if view.controller is not None else 0
        say(console, f"/{view.name}: {'its goal ends: it stops and retreats' if count else 'no goal runs'}")
    return 0


def _find_controllers(operator: Operator) -> None:
    """Find the arms, and the controller of each, which may be found later than its arm."""
    operator.find(FIND, lambda: bool(operator.arms) and all(v.controller for v in operator.arms.values()))


def _arms(names: list[str], operator: Operator) -> list[ArmView]:
    operator.find(FIND)
    return operator.chosen(names)


def _status(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    views = _arms(arguments.arms, operator)
    while True:
        bad = [_show(view, operator, console) for view in views]
        for trouble in operator.troubles():
            say(console, trouble, "yellow")
        if not arguments.watch:
            return int(any(bad))
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            operator.look()
        say(console, "")


def _show(view: ArmView, operator: Operator, console: Console) -> bool:
    """Print what is known of an arm; returns whether something is wrong with it."""
    status, task, contact = view.status, view.controller, view.contact
    if status is None or view.age > 1.0:
        since = "has said nothing" if math.isinf(view.age) else f"has said nothing for {view.age:.1f} s"
        say(console, f"/{view.name}: {since}", "red")
        return True
    wrong = status.mode in (status.FAULT, status.ESTOP)
    say(console, f"/{view.name}: {_mode(status)}", "red" if wrong else "green")
    linear, angular = (math.hypot(*status.twist[k : k + 3]) for k in (0, 3))
    lines = {
        "why": status.reason,
        "commanded by": status.owner or "nobody",
        "speed": f"{1e3 * linear:.1f} mm/s, {math.degrees(angular):.1f} deg/s",
        "limited by": status.limited_by,
        "refused": f"{status.refused} ({status.refused_source})" if status.refused else "",
        "remark": status.remark,
        "task": _task(task),
        "contact": _contact(contact),
        **operator.limits(view.name),
    }
    for name, text in lines.items():
        if text:
            say(console, f"  {name + ':':14}{text}")
    return wrong


def _mode(status: Any) -> str:
    names = {getattr(status, name): name for name in ("RESTING", "MOVING", "STOPPING", "FAULT", "ESTOP")}
    return names.get(status.mode, f"mode {status.mode}").lower()


def _task(status: Any) -> str:
    if status is None:
        return ""
    goal = f" '{status.goal_name}'" if status.goal_name else ""
    why = f": {status.reason}" if status.reason else ""
    return f"{status.task}{goal}, {status.phase}{_done(status.progress, ', ')}{why}"


def _done(progress: float, before: str = "") -> str:
    """How much of a goal is done; '' of one that goes on until it is asked to end."""
    return "" if math.isnan(progress) else f"{before}{100 * progress:.0f} %"


def _contact(state: Any) -> str:
    if state is None:
        return ""
    if state.flags & state.INVALID:
        return "none" if state.flags & state.NO_CONTACT else "nothing is known of it"
    lean = math.degrees(math.hypot(state.euler[3], state.euler[4]))
    return f"{1e3 * state.euler[2]:.2f} mm deep, {lean:.1f} deg from the surface normal"


# ---- parameters ----


def _get(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    if arguments.node is None:
        operator.find(FIND)
        for name in sorted(operator.nodes):
            say(console, name)
        return 0 if operator.nodes else 1
    known = operator.parameters(arguments.node)
    chosen = {name: found for name, found in known.items() if name.startswith(arguments.name)}
    if not chosen:
        raise ValueError(f"{arguments.node}: {unknown_name(arguments.name, list(known))}")
    for name, (value, descriptor) in chosen.items():
        say(console, f"{name}: {value_text(value)}")
        if about := "; ".join(filter(None, [descriptor.description, "fixed" * descriptor.read_only])):
            say(console, f"    {about}", "bright_black")
    return 0


def _set(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    for name, value in [name_and_value(change, EXAMPLE) for change in arguments.changes]:
        before, after = operator.set_parameter(arguments.node, name, value)
        say(console, f"{arguments.node} {name}: {value_text(before)} -> {value_text(after)}")
    return 0


# ---- goals ----


def _goal(arguments: argparse.Namespace, operator: Operator, console: Console) -> int:
    from tactile_base.end_signals import signals_into

    _find_controllers(operator)
    names = [arguments.arm] if arguments.arm else [n for n, view in operator.arms.items() if view.controller]
    view = operator.chosen(names)[0]
    if len(names) > 1:
        raise ValueError(f"--arm: must be one of {', '.join(sorted(names))}")
    if view.controller is None:
        raise ValueError(f"/{view.name} has no controller that takes goals")
    signals: list[int] = []
    signals_into(signals)
    words = {"task": view.controller.task, "name": arguments.name}
    words |= {"goal": arguments.goal, "settings": arguments.settings}
    said: list[str] = []

    def hear(feedback: Any) -> None:
        text = f"{feedback.phase}{feedback.reason and ': '}{feedback.reason}"
        if text not in said[-1:]:
            said.append(text)
            done = _done(feedback.progress)
            say(console, f"{text} ({done})" if done else text)

    result = operator.run_goal(view.name, words, hear, lambda: bool(signals))
    ended = "done" if result.success else f"failed: {result.reason}"
    say(console, f"{ended} ({1e3 * result.path_length:.0f} mm)", "green" if result.success else "red")
    return 0 if result.success else 128 + signals[0] if signals else 1
