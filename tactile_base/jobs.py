"""Many jobs: in this process, in processes of this machine, or on the workers of a Dask scheduler.

A job is a value that can be sent to another process, `work` a callable of it that can be sent as well. What
it is called (its `name`, or the job in words) tells it from the others. A job whose process is killed is run
again, until it had `ATTEMPTS`. Rows of jobs that are done stay in a file; the same jobs go on from there::

    rows = JobRows(folder / "trials.jsonl")
    for done in run_jobs(work, rows.missing(jobs), Workers(processes=4), tell=print):
        rows.add(done.result())
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import pickle
import signal
import subprocess
import sys
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any, Generic, TypeVar

from tactile_base.end_signals import end_with
from tactile_base.input_file import parse_json

T = TypeVar("T")
R = TypeVar("R")
Row = dict[str, Any]
ATTEMPTS = 3  # as many as Dask's scheduler makes by default (allowed-failures)


class ClusterError(ValueError):
    """A cluster that cannot be used."""


class JobLost(RuntimeError):
    """A job whose process was killed each time."""


class _ThereError(Exception):
    """The traceback of an error in another process, as its cause."""


@dataclass(frozen=True)
class Workers:
    """Where jobs run: so many processes here (1: this one), or the workers of a Dask scheduler's address."""

    processes: int = 1
    scheduler: str = ""


@dataclass(frozen=True)
class Outcome(Generic[T, R]):
    """What came of a job: a value, or an error."""

    job: T
    value: R | None = None
    error: Exception | None = None

    def result(self) -> R:
        """The value; raises the error."""
        if self.error is not None:
            raise self.error
        return self.value  # type: ignore[return-value]


def run_jobs(
    work: Callable[[T], R],
    jobs: Sequence[T],
    workers: Workers | None = None,
    tell: Callable[[str], None] | None = None,
    apart: bool = False,
) -> Iterator[Outcome[T, R]]:
    """What came of each job, as they end; leaving the iterator ends what is under way.

    On a cluster the project has to be installed on every machine, and its scheduler runs again what a killed
    worker had (`allowed-failures` times, which its log tells).

    Parameters
    ----------
    tell : gets a sentence when a process was killed
    apart : each job has a process that does nothing else, on a cluster too, whose workers are threads

    Raises
    ------
    ClusterError
        Dask is not installed, or the scheduler does not answer.
    """
    workers = workers or Workers()
    if workers.scheduler:
        yield from _on_cluster(work, jobs, workers.scheduler, apart)
    elif workers.processes == 1 and not apart:
        for job in jobs:
            yield Outcome(job, *_attempt(work, job))
    else:
        yield from _in_processes(work, jobs, workers.processes, tell or (lambda text: None))


def name_of(job: Any) -> str:
    """What a job is called."""
    return str(getattr(job, "name", job))


def _attempt(work: Callable[[T], R], job: T) -> tuple[R | None, Exception | None]:
    try:
        return work(job), None
    except Exception as error:
        return None, error


# ---- processes of this machine ----


class _Process(Generic[T]):
    """A process that does one job after the other; it ends with this one."""

    def __init__(self, work: bytes, threads: int) -> None:
        self.pipe, theirs = Pipe()
        end = str(theirs.fileno())
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tactile_base.jobs", end, str(os.getpid())],
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
            env={
                "OMP_NUM_THREADS": str(threads),
                **os.environ,
                "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
            },
        )
        theirs.close()
        self._send(work)

    def start(self, job: T) -> None:
        self.job = job
        self._send(bytes(ForkingPickler.dumps(job)))

    def _send(self, pickled: bytes) -> None:
        with contextlib.suppress(ConnectionError):  # it was killed; nothing will come of it
            self.pipe.send_bytes(pickled)

    def end(self) -> None:
        self._process.terminate()
        self._process.wait()
        self.pipe.close()

    def fate(self) -> str:
        """How it ended."""
        status = self._process.wait()
        return f"was killed by {signal.Signals(-status).name}" if status < 0 else f"ended with {status}"


def _in_processes(
    work: Callable[[T], R], jobs: Sequence[T], count: int, tell: Callable[[str], None]
) -> Iterator[Outcome[T, R]]:
    waiting, attempts = deque(jobs), Counter[str]()
    idle: list[_Process[T]] = []
    busy: dict[Any, _Process[T]] = {}
    threads = max(1, len(os.sched_getaffinity(0)) // count)
    pickled = bytes(ForkingPickler.dumps(work))  # once, as it may be large
    try:
        while waiting or busy:
            while waiting and len(busy) < count:
                process = idle.pop() if idle else _Process(pickled, threads)
                busy[process.pipe] = process
                process.start(waiting.popleft())
            for pipe in wait(list(busy)):
                process = busy.pop(pipe)
                try:
                    outcome = _received(process)
                except (EOFError, ConnectionError):
                    name = name_of(process.job)
                    attempts[name] += 1
                    what = f"{name}: its process {process.fate()}"
                    if attempts[name] < ATTEMPTS:
                        tell(f"{what}; it is run again")
                        waiting.appendleft(process.job)
                        continue
                    outcome = Outcome(process.job, error=JobLost(f"{what}, as {ATTEMPTS - 1} before"))
                else:
                    idle.append(process)
                yield outcome
    finally:
        for process in (*idle, *busy.values()):
            process.end()


def _received(process: _Process[T]) -> Outcome[T, Any]:
    value, error, trace = process.pipe.recv()
    if error is not None:
        error.__cause__ = _ThereError(trace)
    return Outcome(process.job, value, error)


def main() -> None:
    """One of the processes: does the jobs that come through the pipe of this number."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C, which it gets as well, is for who started it
    end_with(int(sys.argv[2]))
    pipe = Connection(int(sys.argv[1]))
    work, error = _attempt(Connection.recv, pipe)
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        value, failure = (None, error) if work is None else _attempt(work, job)
        pipe.send((value, *_sendable(failure)))


def _sendable(error: Exception | None) -> tuple[Exception | None, str]:
    if error is None:
        return None, ""
    trace = "".join(traceback.format_exception(error))
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # of its own class, which cannot be made again elsewhere
        error = RuntimeError(f"{type(error).__name__}: {error}")
    return error, trace


# ---- a cluster ----


def _on_cluster(
    work: Callable[[T], R], jobs: Sequence[T], scheduler: str, apart: bool
) -> Iterator[Outcome[T, R]]:
    with _client(scheduler) as client:
        from distributed import KilledWorker, as_completed

        there = client.submit(_same, work, pure=False)  # sent once, not with each job
        call = _call_apart if apart else _call
        futures = {client.submit(call, there, job, pure=False): job for job in jobs}
        for future in as_completed(list(futures)):
            job, error = futures[future], future.exception()
            if isinstance(error, KilledWorker):
                error = JobLost(f"{name_of(job)}: {error}")
            yield Outcome(job, None if error else future.result(), error)


def _client(scheduler: str) -> Any:
    """The `distributed.Client` of a scheduler's address; a context that ends the connection."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        if error.name not in ("distributed", "dask"):
            raise
        raise ClusterError("--scheduler needs Dask: pip install distributed") from error
    try:
        return Client(scheduler, timeout=10)
    except (OSError, ValueError, TypeError) as error:
        raise ClusterError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error})") from error


def _same(work: T) -> T:
    return work


def _call(work: Callable[[T], R], job: T) -> R:
    return work(job)


def _call_apart(work: Callable[[T], R], job: T) -> R:
    return next(run_jobs(work, [job], apart=True)).result()


# ---- what is done ----


class JobRows:
    """The rows of the jobs that are done, in a file with one JSON object a line; `name` is that of the job.

    A row is written whole, at once: an interruption costs the jobs under way. A last line that ends early,
    as where the power failed, is cut off.

    Raises `ValueError` if a line of the file is no row, with its number.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._rows = {row["name"]: row for row in self._read()}

    def __len__(self) -> int:
        return len(self._rows)

    def missing(self, jobs: Sequence[T]) -> list[T]:
        """Those that are not done yet."""
        return [job for job in jobs if name_of(job) not in self._rows]

    def of(self, jobs: Sequence[Any]) -> list[Row]:
        """The rows of those that are done, in their order."""
        return [self._rows[name_of(job)] for job in jobs if name_of(job) in self._rows]

    def add(self, row: Row) -> None:
        """Keep a row."""
        line = json.dumps(row).encode() + b"\n"
        try:
            with self.path.open("ab", buffering=0) as file:
                whole = file.write(line) == len(line)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from error
        if not whole:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
        self._rows[row["name"]] = row

    def _read(self) -> Iterator[Row]:
        if not self.path.exists():
            return
        *lines, rest = self.path.read_bytes().split(b"\n")
        if rest:
            os.truncate(self.path, self.path.stat().st_size - len(rest))
        for number, line in enumerate(lines, start=1):
            try:
                row = parse_json(line.decode())
                if not isinstance(row, dict) or not isinstance(row.get("name"), str):
                    raise ValueError("it has no name")
            except ValueError as error:
                raise ValueError(
                    f"{self.path}:{number}: is no row of a job ({error}); remove the line or the file"
                ) from error
            yield row


if __name__ == "__main__":
    main()
