"""The stop line of an arm: a socket of this host by which its user stops it within milliseconds.

ROS needs one to three seconds until a new terminal has found the nodes of a graph; a socket in a folder that
both know needs none. The folder belongs to one user, and tells which arms run in which ROS domain. What it
can do is stop an arm and ask about it, nothing else; arms of other users and other hosts are stopped by
`/estop`. Whoever calls needs the standard library alone, which is what makes it fast.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import re
import select
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

# Whoever stops an arm waits for what is imported here: no dataclasses, no pathlib.

STOP, ASK, _END = b"stop", b"ask", b"end"
LOOK = 0.005  # s between two looks at an arm that somebody waits for
LONGEST = 4096  # bytes of a call, and of an answer
_NAME = re.compile(r"(\d+)-(\d+)-(\d+)")  # domain, process, number


class Word(NamedTuple):
    """What an arm answers.

    Attributes
    ----------
    arm : its namespace
    domain, pid : ROS domain and process of its node
    rests : whether it is stopped and at rest
    text : what it does, for a person
    """

    arm: str
    domain: int
    pid: int
    rests: bool
    text: str


def folder() -> str:
    """Where the lines of this user's arms are; made for this user alone if it is not there.

    Raises `PermissionError` if somebody else has made it, or may write to it: what lies there is not to be
    believed.
    """
    path = os.environ.get("TACTILE_STOP_FOLDER") or f"/tmp/tactile_servoing-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        os.mkdir(path, 0o700)
    found = os.lstat(path)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise PermissionError(
            f"{path}: must be a folder that belongs to you and that nobody else may write to"
        )
    return path


class StopLine:
    """An arm's end of its line, served by a thread of its own until `close`.

    Parameters
    ----------
    arm : the arm's namespace
    domain : its ROS domain
    stop : stops the arm at once; is given a reason
    look : whether the arm is stopped and at rest, and what it does in words
    """

    _numbers = iter(range(1 << 30))

    def __init__(
        self, arm: str, domain: int, stop: Callable[[str], None], look: Callable[[], tuple[bool, str]]
    ) -> None:
        self.arm, self.domain = arm, domain
        self._stop, self._look = stop, look
        self._path = os.path.join(folder(), f"{domain}-{os.getpid()}-{next(self._numbers)}")
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self._path)
        self._waiting: set[bytes | str] = set()
        self._thread = threading.Thread(target=self._serve, name=f"stop line of {arm}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Hang up."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as own, contextlib.suppress(OSError):
            own.sendto(_END, self._path)
        self._thread.join()
        _remove(self._path)
        self._socket.close()

    def _serve(self) -> None:
        while True:
            if select.select([self._socket], [], [], LOOK if self._waiting else None)[0]:
                asked, sender = self._socket.recvfrom(LONGEST)
                if asked == _END:
                    return
                what, _, names = asked.partition(b" ")
                if what == STOP and (not names or self.arm.encode() in names.split()):
                    self._stop("asked for by `tactile stop`")
                    self._waiting.add(sender)
                if what in (STOP, ASK):
                    self._answer(sender)
            if self._waiting and self._look()[0]:
                for sender in self._waiting:
                    self._answer(sender)
                self._waiting.clear()

    def _answer(self, sender: bytes | str) -> None:
        rests, text = self._look()
        word = {"arm": self.arm, "domain": self.domain, "pid": os.getpid(), "rests": rests, "text": text}
        with contextlib.suppress(OSError, TypeError):  # whoever asked has gone, or has no address
            self._socket.sendto(json.dumps(word).encode()[:LONGEST], socket.MSG_DONTWAIT, sender)


class StopCaller:
    """The other end of the lines of all arms of this user, in one ROS domain or in all of them (None)."""

    def __init__(self, domain: int | None = None) -> None:
        self.domain = domain
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("")  # any free name, by which arms answer
        self._folder = folder()

    def __enter__(self) -> StopCaller:
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()

    def call(self, what: bytes, arms: Iterable[str] = ()) -> int:
        """Tell arms to STOP, or ASK them; returns how many answer: all that there are.

        With the names of `arms`, only these stop: each line knows whose it is, which nobody asks first.
        """
        call = b" ".join([what, *map(os.fsencode, arms)])
        return sum(self._send(call, path) for path in self._lines())

    def words(self, timeout_s: float) -> Iterator[Word]:
        """What the arms answer, as it comes, for so long."""
        end = time.monotonic() + timeout_s
        while (left := end - time.monotonic()) > 0.0 and select.select([self._socket], [], [], left)[0]:
            yield Word(**json.loads(self._socket.recv(LONGEST)))

    def _lines(self) -> list[str]:
        found = [name for name in map(_NAME.fullmatch, os.listdir(self._folder)) if name]
        wanted = None if self.domain is None else str(self.domain)
        return [os.path.join(self._folder, name[0]) for name in found if wanted in (None, name[1])]

    def _send(self, what: bytes, path: str) -> bool:
        try:
            self._socket.sendto(what, socket.MSG_DONTWAIT, path)
        except (ConnectionRefusedError, FileNotFoundError):  # its process was killed, or has just ended
            _remove(path)
            return False
        except BlockingIOError:  # full: its node stands still
            return True
        return True


def _remove(path: str) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.unlink(path)


def arms_here(domain: int | None = None, timeout_s: float = 0.2) -> list[Word]:
    """The arms of this user on this host that answer within so long."""
    with StopCaller(domain) as caller:
        count = caller.call(ASK)
        found = list(itertools.islice(caller.words(timeout_s), count))
        return sorted(found, key=lambda word: (word.domain, word.arm))
