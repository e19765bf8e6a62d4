"""Jobs whose results are known, in a module that other processes can import."""

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Square:
    number: int

    @property
    def name(self) -> str:
        return f"square/{self.number}"


def square(job):
    return {"name": job.name, "result": job.number**2}


def refuse(job):
    raise ValueError(f"{job.name} cannot be")


class OddError(Exception):
    """One that cannot be made again from its text."""

    def __init__(self, number: int, what: str) -> None:
        super().__init__(f"{what} {number}")


def refuse_oddly(job):
    raise OddError(job.number, "odd")


@dataclass(frozen=True)
class Killing:
    """Squares, whose process is killed in job 3 so many times; notes each attempt in a folder."""

    folder: Path
    times: int
    number: int = 3

    def __call__(self, job):
        attempt = len(list(self.folder.glob(f"{job.number}-*")))
        (self.folder / f"{job.number}-{attempt}").touch()
        if job.number == self.number and attempt < self.times:
            os.kill(os.getpid(), signal.SIGKILL)
        return square(job)


@dataclass(frozen=True)
class Slowly:
    """Squares that take a while; each notes its process."""

    folder: Path

    def __call__(self, job):
        (self.folder / f"pid-{os.getpid()}").touch()
        time.sleep(0.3)
        return square(job)
