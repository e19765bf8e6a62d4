"""A table in the terminal beside a running graph: settings of all nodes, to see, change, undo and save.

Each has its range and meaning, the value that its node was started with, and the one in force. A changed one
is in force at once, or is refused and why; undo, two sets to go to and fro between, files that the next
launch takes. ? shows the keys.
"""

from __future__ import annotations

import argparse
import functools
import queue
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from rich.live import Live

from tactile_base.console import lasting_console, say
from tactile_base.end_signals import signals_into
from tactile_base.keys import Keys
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.operate import chosen_domain
from tactile_bringup.tune_screen import TuneScreen, keys_of
from tactile_bringup.tuning import Request, Tuning

if TYPE_CHECKING:
    from tactile_bringup.launching.operator import Operator

LOOK = 1.0  # s, between looks for nodes that come and go
KEYS = 0.1  # s, for which a key is waited for
ESCAPE = 0.05  # s, within which the rest of a key that begins with Escape comes
Post = Callable[[Callable[[], None]], None]


def register(subparsers: Any) -> None:
    epilog = "exit codes: 0 ended by the user, 2 no terminal"
    add = add_command(subparsers, "tune", run, __doc__, epilog=epilog).add_argument
    add("find", nargs="?", default="", metavar="TEXT", help="show only what has it in node or name")


def run(arguments: argparse.Namespace) -> int:
    """Show the table until the user ends it; returns the exit code."""
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ValueError(
            "needs a terminal; without one use tactile get NODE, and tactile set NODE NAME=VALUE"
        )
    from tactile_bringup.launching.hands import Hands, carry_out
    from tactile_bringup.launching.operator import Operator

    domain, posted = chosen_domain(), queue.SimpleQueue[Callable[[], None]]()

    def ask(request: Request) -> None:
        def act(operator: Operator) -> str:
            done = carry_out(operator, request)
            posted.put(lambda: screen.finished(request, *done))
            return ""

        hands.ask(act)

    screen = TuneScreen(Tuning(), ask, f"tactile tune, ROS domain {domain}", arguments.find)
    watch = _Watch(screen, posted.put)
    operator = Operator(domain, looks=False)
    hands = Hands(operator, lambda text, ok: posted.put(lambda: screen.say(text, ok)), watch.look)
    signals = list[int]()
    signals_into(signals)
    try:
        _show(screen, posted, lambda: bool(signals) or screen.ended)
    finally:
        hands.close()
    for line in screen.written:
        say(lasting_console(), line)
    return 0 if signals[:1] in ([], [2]) else 128 + signals[0]


def _show(
    screen: TuneScreen, posted: queue.SimpleQueue[Callable[[], None]], ends: Callable[[], bool]
) -> None:
    """Draw, and hand over keys and what the other thread posts, until it `ends`."""
    console, size = lasting_console(), (0, 0)
    with Keys() as keys, Live(screen, console=console, screen=True, auto_refresh=False) as live:
        while not ends():
            typed = keys.pressed(KEYS)
            if typed.endswith(("\x1b", "\x1b[", "\x1bO")):
                typed += keys.pressed(ESCAPE)
            news = bool(typed) or console.size != size
            for key in keys_of(typed):
                screen.press(key)
            while not posted.empty():
                posted.get()()
                news = True
            if news:
                size = console.size
                live.refresh()


class _Watch:
    """Looks at nodes that come and go, and hears what changes, in the thread of `Hands`; posts it."""

    def __init__(self, screen: TuneScreen, post: Post) -> None:
        self._screen, self._post = screen, post
        self._known, self._due = set[str](), 0.0
        self._held: list[tuple[str, str, Any]] | None = None  # what changed while a node was read

    def look(self, operator: Operator) -> None:
        """Called again and again."""
        if not self._due:
            operator.hear_parameters(self._hear)
        operator.look()
        if time.monotonic() < self._due:
            return
        self._due = time.monotonic() + LOOK
        there = operator.nodes_with_parameters()
        gone, new = sorted(self._known - there), sorted(there - self._known)
        for node in gone:
            self._post(functools.partial(self._screen.tuning.gone, node))
        self._known &= there
        for node in new:
            self._read(operator, node)
        told = [f"{what}: {', '.join(nodes)}" for what, nodes in (("gone", gone), ("new", new)) if nodes]
        if told:
            self._post(functools.partial(self._screen.say, "; ".join(told), not gone))

    def _read(self, operator: Operator, node: str) -> None:
        from tactile_bringup.launching.hands import settings_of

        held: list[tuple[str, str, Any]] = []
        self._held = held
        try:
            self._post(functools.partial(self._screen.tuning.found, node, settings_of(operator, node)))
            self._known.add(node)
        finally:
            self._held = None
        for change in held:
            self._hear(*change)

    def _hear(self, node: str, name: str, value: Any) -> None:
        if self._held is not None:
            self._held.append((node, name, value))
            return

        def tell() -> None:
            if said := self._screen.tuning.heard(node, name, value):
                self._screen.say(said)

        self._post(tell)
