"""Child processes that end with their parent: start, watch, stop, and report what a dead one said last.

Each child leads its own session, so a Ctrl-C in the terminal reaches only the parent, which then stops the
children in order. Three things keep orphans away: `stop` escalates (SIGINT, SIGTERM, SIGKILL); the kernel
sends SIGTERM to children whose parent dies (PR_SET_PDEATHSIG); and a keeper process ends with SIGKILL what is
left of a parent that was killed, then removes its shared memory.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import IO

from tactile_base.end_signals import end_with
from tactile_base.raised import BY_ERROR, CAUSES
from tactile_bringup.launching.keeper import signal_group

_PACKAGE_ROOT = Path(__file__).resolve().parents[2]
TAIL_LINES = 15


class ProcessDied(RuntimeError):
    """A child that ended although nobody asked it to.

    Attributes
    ----------
    name : name of the process
    exit_code : as in `subprocess`: negative for a signal
    log : where its output is
    """

    def __init__(self, name: str, exit_code: int, log: Path) -> None:
        self.name, self.exit_code, self.log = name, exit_code, log
        super().__init__(f"{name} {describe_exit(exit_code)}{_last_output(log)}")


@dataclass(frozen=True)
class Stopped:
    """How one child ended: its exit code, and the signal that it took beyond the first ("" for none)."""

    name: str
    exit_code: int
    log: Path
    escalated_to: str = ""

    def __str__(self) -> str:
        killed = self.escalated_to == signal.SIGKILL.name
        how = "did not end when it was asked to" if killed else describe_exit(self.exit_code)
        return f"{self.name} {how}{_last_output(self.log)}"


@dataclass
class Child:
    """A started process and where its output goes."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path


class ProcessGroup:
    """The children of one run, stopped in the reverse of the order in which they were started.

    Use as a context manager, from the main thread (the kernel ends the children with the thread that started
    them)::

        with ProcessGroup() as group:
            group.start("sim", [sys.executable, "-m", "..."], environment, log=Path("sim.log"))
            while working:
                group.check()  # raises ProcessDied
    """

    def __init__(self, grace_s: float = 5.0, kill_after_s: float = 2.0) -> None:
        self.grace_s, self.kill_after_s = grace_s, kill_after_s
        self.children: dict[str, Child] = {}
        self.stopped: list[Stopped] = []
        self._keeper = _Keeper()

    def __enter__(self) -> ProcessGroup:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def start(self, name: str, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Child:
        """Start a child whose output and errors go into `log`; raises FileNotFoundError, PermissionError."""
        if name in self.children:
            raise ValueError(f"a process named {name} runs already")
        log.parent.mkdir(parents=True, exist_ok=True)
        parent = os.getpid()
        with log.open("wb") as output:
            process = subprocess.Popen(
                list(command),
                env=dict(environment),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=lambda: _end_with(parent),
            )
        self._keeper.watch(process.pid)
        self.children[name] = Child(name, process, log)
        return self.children[name]

    def check(self) -> None:
        """Raise `ProcessDied` for the first child that ended by itself, whatever its exit code."""
        for child in self.children.values():
            code = child.process.poll()
            if code is not None:
                raise ProcessDied(child.name, code, child.log)

    def stop(self, names: Collection[str] | None = None, urgent: bool = False) -> list[Stopped]:
        """Stop these children, or all: SIGINT, after `grace_s` SIGTERM, then SIGKILL; at once if `urgent`."""
        children = [c for c in reversed(self.children.values()) if names is None or c.name in names]
        steps = [(signal.SIGINT, self.grace_s), (signal.SIGTERM, self.kill_after_s), (signal.SIGKILL, None)]
        escalated: dict[str, str] = {}
        for number, wait_s in steps[-1:] if urgent else steps:
            running = [child for child in children if child.process.poll() is None]
            for child in running:
                escalated[child.name] = "" if number == signal.SIGINT else signal.Signals(number).name
                signal_group(child.process.pid, number)
            _wait(running, wait_s)
        reports = [Stopped(c.name, c.process.wait(), c.log, escalated.get(c.name, "")) for c in children]
        for child in children:
            self._forget(child)
        self.stopped += reports
        return reports

    def close(self) -> None:
        """Stop what still runs, and the keeper."""
        self.stop()
        self._keeper.close()

    def _forget(self, child: Child) -> None:
        signal_group(child.process.pid, signal.SIGKILL)  # whatever it started itself and left behind
        self._keeper.release(child.process.pid)
        del self.children[child.name]


class _Keeper:
    """The other end of `tactile_bringup.launching.keeper`: tells it by pipe which process groups are ours."""

    def __init__(self) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-S", "-m", "tactile_bringup.launching.keeper", str(time.time_ns())],
            # PYTHONSAFEPATH: not what lies in the current folder
            env={"PYTHONPATH": str(_PACKAGE_ROOT), "PYTHONSAFEPATH": "1", "PATH": os.environ.get("PATH", "")},
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        self._pipe: IO[bytes] = self._process.stdin

    def watch(self, pid: int) -> None:
        self._say(f"watch {pid}")

    def release(self, pid: int) -> None:
        self._say(f"release {pid}")

    def close(self) -> None:
        if not self._pipe.closed:
            self._pipe.close()
        self._process.wait()

    def _say(self, line: str) -> None:
        self._pipe.write(line.encode() + b"\n")
        self._pipe.flush()


def describe_exit(code: int) -> str:
    """An exit code in words, as `ended with exit code 1` or `was killed by SIGSEGV`."""
    if code >= 0:
        return f"ended with exit code {code}"
    try:
        return f"was killed by {signal.Signals(-code).name}{_killer() if -code == signal.SIGKILL else ''}"
    except ValueError:
        return f"was killed by signal {-code}"


def memory_kills(counters: Path = Path("/proc/vmstat")) -> int | None:
    """How many processes the kernel has killed as memory ran out, of machine or container; None: not told."""
    try:
        lines = counters.read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), None)


_MEMORY_KILLS = memory_kills()  # before any child was started


def _killer() -> str:
    """Who probably has sent a SIGKILL that is not ours."""
    now = memory_kills()
    if now is None or _MEMORY_KILLS is None:
        return ""
    if now > _MEMORY_KILLS:
        return ", probably by the kernel because memory ran out (`dmesg` names whom it killed; `free -h`)"
    return ", by a person or a program: not by the kernel for want of memory"


def tail(log: Path, lines: int = TAIL_LINES) -> str:
    """The last lines of a log, or a note that there is none."""
    try:
        text = log.read_text(errors="replace").rstrip()
    except FileNotFoundError:
        return "(no log)"
    return "\n".join(text.splitlines()[-lines:]) if text else "(it wrote nothing)"


def cause(log: Path) -> str:
    """What a node says in its log of why it ended, as it begins in `CAUSES`; '' where it says nothing."""
    try:
        lines = log.read_text(errors="replace").splitlines()
    except FileNotFoundError:
        return ""
    found = (line[line.index(words) :] for line in reversed(lines) for words in CAUSES if words in line)
    return next(found, "").removeprefix(BY_ERROR)


def _last_output(log: Path) -> str:
    said = cause(log)
    return f"{': ' if said else ''}{said}; log: {log}\n{textwrap.indent(tail(log), '    ')}"


def _end_with(parent: int) -> None:
    """In the child, before exec: take Ctrl-C as usual; end with the parent, also with one just dead."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored in the children of a shell's background jobs
    end_with(parent)


def _wait(children: Sequence[Child], timeout_s: float | None) -> None:
    deadline = None if timeout_s is None else time.monotonic() + timeout_s
    for child in children:
        try:
            child.process.wait(None if deadline is None else max(0.0, deadline - time.monotonic()))
        except subprocess.TimeoutExpired:
            return
