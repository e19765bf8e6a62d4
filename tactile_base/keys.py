"""Single keys of a terminal, without Enter, for commands that go on meanwhile."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from typing import Any


class Keys:
    """Hears keys while it is a context; where standard input is no terminal there are none.

    Ctrl-C stays a signal. In the background of its terminal nothing is read, which would stop the process.
    """

    def __init__(self) -> None:
        self._fd = -1
        self._before: list[Any] = []

    def __enter__(self) -> Keys:
        if sys.stdin is not None and sys.stdin.isatty() and self._foreground(sys.stdin.fileno()):
            self._fd = sys.stdin.fileno()
            self._before = termios.tcgetattr(self._fd)
            tty.setcbreak(self._fd)
        return self

    def __exit__(self, *exception: object) -> None:
        if self.there and self._foreground(self._fd):
            termios.tcsetattr(self._fd, termios.TCSADRAIN, self._before)

    @property
    def there(self) -> bool:
        """Whether there is a terminal whose keys are heard."""
        return self._fd >= 0

    def pressed(self, timeout_s: float = 0.0) -> str:
        """The keys since the last call, waiting for so long at most for the first; '' for none."""
        if not self.there or not self._foreground(self._fd):
            return ""
        if not select.select([self._fd], [], [], timeout_s)[0]:
            return ""
        return os.read(self._fd, 16).decode(errors="replace")

    @staticmethod
    def _foreground(fd: int) -> bool:
        try:
            return os.tcgetpgrp(fd) == os.getpgrp()
        except OSError:  # the terminal was closed
            return False
