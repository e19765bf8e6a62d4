"""`tactile stop`: brings every arm of this user on this host to rest, and whatever else hears /estop.

Arms that were started on this host are reached by their stop lines within milliseconds; then /estop is
published for what listens on other hosts or belongs to other users, which ROS takes a few seconds to find.
With ROS_DOMAIN_ID set, only arms of that domain are stopped. `tactile reset` lets them move again.

With names, only these arms of this host are stopped, and no /estop is published. A name that none of them has
stops all arms, as without names, and the exit code is 1: a stop too many is safer than one too few.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import time
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from tactile_base.stop_line import STOP, StopCaller, arms_here

if TYPE_CHECKING:
    from tactile_base.keys import Keys
    from tactile_bringup.launching.operator import ArmView, Operator

# Nothing else is imported here: this command is called when every millisecond counts.

BRAKES = 2.0  # s, for an arm to come to rest
SEARCH = 3.0  # s, for arms that only ROS can find
LOOK = 0.05  # s, for arms of this host to answer
AGAIN, PRESSED = 0.5, 0.01  # s, between two looks for arms, and for a key
READY = "any key stops all arms; q or Ctrl-C ends this command"
#: Of each arm, by ROS domain and name: why it is not known to rest; '' where it does.
Arms = dict[tuple[int, str], str]


def register(subparsers: Any) -> None:
    from tactile_bringup.commands.changes import add_command

    _add_options(add_command(subparsers, "stop", run, __doc__))


def main(words: Sequence[str]) -> int:
    """`tactile stop` with these options, before anything else of `tactile` is loaded."""
    parser = _add_options(argparse.ArgumentParser(prog="tactile stop", description=__doc__))
    return run(parser.parse_args(words))


def _add_options(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    parser.add_argument("arms", nargs="*", metavar="ARM", help="(default, and for an unknown name: all)")
    parser.add_argument("--ready", action="store_true", help="find all arms now, and stop them by a key")
    parser.add_argument("--here", action="store_true", help="only arms that this user started on this host")
    parser.set_defaults(run=run)
    return parser


def run(arguments: argparse.Namespace) -> int:
    if arguments.ready and arguments.arms:
        print("tactile stop: --ready stops all arms: leave the names out", file=sys.stderr)
        return 2
    wanted = {f"/{name.strip('/')}" for name in arguments.arms}
    given = os.environ.get("ROS_DOMAIN_ID", "")
    domain = int(given) if given.isdigit() else None
    arms: Arms = {}
    unknown = wanted
    try:
        with StopCaller(domain) as caller:
            if arguments.ready:
                _take_time()
                return _stay_ready(caller, arguments.here)
            arms = _stop_here(caller, wanted)
            unknown = wanted.difference(name for _, name in arms)
            if unknown:
                arms = _stop_here(caller)
    except OSError as error:  # of the folder: then there is ROS
        print(f"tactile stop: {error}", file=sys.stderr)
    _take_time()
    if not arguments.here and (unknown or not wanted):
        domains = {found for found, _ in arms} if domain is None else {domain}
        _stop_elsewhere(domains or {0}, arms)
    if unknown:
        found = ", ".join(sorted({name for _, name in arms})) or "none"
        print(
            f"tactile stop: no arm of this host is called {', '.join(sorted(unknown))}; all that were found "
            f"were told to stop: {found}",
            file=sys.stderr,
        )
    return max(_judge(arms), bool(unknown))


def _take_time() -> None:
    """What follows takes processor time that arms may need: no real-time priority for it."""
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _wait_in_a_hurry() -> None:
    """Be woken by a key before what has no real-time priority, and after nodes; where this user may."""
    with contextlib.suppress(PermissionError):
        lowest = os.sched_param(os.sched_get_priority_min(os.SCHED_FIFO))
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, lowest)  # of this thread alone


# ---- arms of this host ----


def _stop_here(caller: StopCaller, wanted: Collection[str] = ()) -> Arms:
    """Stop what has a stop line, or of these the arms that are wanted; tells of each when it rests."""
    begun = time.monotonic()
    count = caller.call(STOP, wanted)
    arms: Arms = {}
    others: set[tuple[int, str]] = set()
    for word in caller.words(BRAKES) if count else ():
        key, ms = (word.domain, word.arm), 1e3 * (time.monotonic() - begun)
        if wanted and word.arm not in wanted:
            others.add(key)
        else:
            if key not in arms:
                _say(f"{word.arm} was told to stop after {ms:.0f} ms (ROS domain {word.domain})")
            if word.rests and arms.get(key) != "":
                _say(f"{word.arm} rests after {ms:.0f} ms")
            arms[key] = "" if word.rests else word.text
        if list(arms.values()).count("") + len(others) == count:
            break
    silent = count - len(arms) - len(others)
    if silent and not any(name in wanted for _, name in arms):
        arms[-1, f"{silent} of {count} arms"] = "no answer: their nodes are held up"
    return arms


def _judge(arms: Arms) -> int:
    for (_, name), moves in sorted(arms.items()):
        if moves:
            print(f"tactile stop: {name} was not seen at rest: {moves}", file=sys.stderr)
    if not arms:
        print("tactile stop: no arm was found", file=sys.stderr)
    return 1 if any(arms.values()) or not arms else 0


def _say(text: str) -> None:
    print(text, flush=True)


# ---- what only ROS finds ----


class _Others:
    """Arms that /estop reaches, in the domains that were named so far."""

    def __init__(self) -> None:
        self._operators: dict[int, Operator] = {}

    def __enter__(self) -> _Others:
        return self

    def __exit__(self, *exception: object) -> None:
        for operator in self._operators.values():
            operator.close()

    def join(self, domains: Iterable[int]) -> None:
        """Look for arms in these domains, too."""
        from tactile_bringup.launching.operator import Operator

        for domain in set(domains) - set(self._operators):
            self._operators[domain] = Operator(domain)

    def look(self) -> None:
        """Take in what has come."""
        for operator in self._operators.values():
            operator.look()

    def stop(self) -> None:
        """Publish /estop once."""
        for operator in self._operators.values():
            operator.stop()

    def stop_all(self, seconds: float, arms: Arms, search: bool) -> None:
        """Publish /estop to whoever is found; tells of arms that come to rest, and puts all into `arms`.

        With `search` all of that time is used, to find more.
        """
        here, end = set(arms), time.monotonic() + seconds
        while time.monotonic() < end:
            for operator in self._operators.values():
                operator.stop_new()
            self.look()
            for key, view in self._views():
                if key not in here and arms.get(key) != "":
                    arms[key] = "" if view.stopped else "told by /estop"
                    if view.stopped:
                        _say(f"{key[1]} rests (by /estop, ROS domain {key[0]})")
            if not (search or any(arms.values())):
                return

    def _views(self) -> list[tuple[tuple[int, str], ArmView]]:
        """The arms that were found, each with its ROS domain and name."""
        operators = self._operators.items()
        return [((domain, f"/{name}"), view) for domain, op in operators for name, view in op.arms.items()]

    def names(self) -> set[str]:
        """Of all arms that were found."""
        return {name for (_, name), _ in self._views()}


def _stop_elsewhere(domains: Iterable[int], arms: Arms) -> None:
    """Find and stop what only ROS finds, too."""
    with _Others() as others:
        try:
            others.join(domains)
        except ImportError as error:
            _say(f"/estop was not published, for want of ROS 2: {error}")
        else:
            others.stop_all(SEARCH, arms, search=True)


# ---- a stop that is ready ----


def _stay_ready(caller: StopCaller, here: bool) -> int:
    """Keep looking for arms until a key stops them; again and again until somebody ends it."""
    from tactile_base.keys import Keys

    known: set[str] | None = None
    with Keys() as keys, _Others() as others:
        if not keys.there:
            print("tactile stop: --ready needs a terminal, for its keys", file=sys.stderr)
            return 2
        if not here and caller.domain is not None:
            others.join([caller.domain])
        _wait_in_a_hurry()
        _say(READY)
        while True:
            words = arms_here(caller.domain, LOOK)
            if not here:
                others.join(word.domain for word in words)
            found = {word.arm for word in words} | others.names()
            if found != known:
                known = found
                _say(f"ready to stop: {', '.join(sorted(found)) or 'nothing yet'}")
            key = _next_key(keys, others)
            if key == "q":
                return 0
            if key:
                others.stop()
                arms = _stop_here(caller)
                others.stop_all(BRAKES, arms, search=False)
                _judge(arms)


def _next_key(keys: Keys, others: _Others) -> str:
    """A key that is pressed before it is time to look for arms again."""
    end = time.monotonic() + AGAIN
    while time.monotonic() < end:
        if key := keys.pressed(PRESSED):
            return key
        others.look()
    return ""
