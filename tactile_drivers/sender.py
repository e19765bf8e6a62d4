"""Sender: hands commands to a driver whose calls may take their time, in a thread of its own.

Whoever commands does not wait, and of commands that come meanwhile the newest counts. A stop goes to the
driver at once, past a call that is under way, and once more when that one has returned.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from tactile_scene.arm import LONGEST_CALL, Arm

_TOLD_FOR = 10.0  # s, that a call which took too long is told


class CallTimer:
    """How long the calls of a driver take."""

    def __init__(self) -> None:
        self._text, self._until = "", 0.0

    @property
    def remark(self) -> str:
        """The last call that took longer than the contract allows, for `_TOLD_FOR` s after it; else ''."""
        return self._text if time.perf_counter() < self._until else ""

    def __call__(self, name: str, call: Callable[..., Any], *arguments: Any) -> None:
        """Make a call, and take its time."""
        begun = time.perf_counter()
        call(*arguments)
        taken = time.perf_counter() - begun
        if taken > LONGEST_CALL:
            self._text = f"the driver's {name} took {taken:.3f} s (at most {LONGEST_CALL:g} s)"
            self._until = begun + taken + _TOLD_FOR


class Sender:
    """A driver (`Arm`) that takes commands at once, whatever the driver behind it takes for them."""

    prompt = True

    def __init__(self, driver: Arm) -> None:
        self._driver, self._timer = driver, CallTimer()
        self._news = threading.Condition()  # held for no call of the driver
        self._waiting: tuple[int, ArrayLike] | None = None
        self._stops, self._reason, self._open = 0, "", True
        self._failed: Exception | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._driver, name)

    @property
    def remark(self) -> str:
        """See `CallTimer`."""
        return self._timer.remark

    def command(self, stamp_ns: int, twist: ArrayLike) -> None:
        """Have the driver follow a twist once it has taken the last one; raises what that one raised."""
        if self._failed is not None:
            raise self._failed
        with self._news:
            self._waiting = stamp_ns, twist
            self._news.notify()

    def stop(self, reason: str) -> None:
        """Have the driver stop, now; what waits to be sent is dropped."""
        with self._news:
            self._waiting, self._reason = None, reason
            self._stops += 1
        self._timer("stop", self._driver.stop, reason)

    def close(self) -> None:
        """Close the driver; a command that hangs is not waited for."""
        with self._news:
            self._waiting, self._open = None, False
            self._news.notify()
        self._driver.close()

    def _run(self) -> None:
        while True:
            with self._news:
                self._news.wait_for(lambda: self._waiting is not None or not self._open)
                if self._waiting is None:
                    return
                (stamp_ns, twist), self._waiting = self._waiting, None
                stops = self._stops
            try:
                self._timer("command", self._driver.command, stamp_ns, twist)
                if self._stops != stops:  # a stop came while it was under way, and this may have undone it
                    self._driver.stop(self._reason)
            except Exception as error:  # for whoever commands next
                self._failed = error
                return
