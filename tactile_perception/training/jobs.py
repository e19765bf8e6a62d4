"""Many training runs: one after the other, in several processes, or on the machines of a Dask cluster."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_base.cluster import cluster_client
from tactile_perception.training.config import TrainConfig
from tactile_perception.training.run_folder import RESULT_NAME, STATE_NAME, RunFolder

LOG_NAME = "train.log"
_POLL_SECONDS = 0.3


class JobError(ValueError):
    """A run that failed."""


@dataclass(frozen=True)
class Job:
    """One training run, in terms that can be sent to another process or machine; paths are absolute."""

    data: str
    out: str
    sections: dict[str, Any]
    validation: str | None = None
    limit: int | None = None

    @property
    def name(self) -> str:
        return Path(self.out).name

    @property
    def folder(self) -> RunFolder:
        return RunFolder(self.out)

    @property
    def config(self) -> TrainConfig:
        return TrainConfig.from_mapping(self.sections)


def seed_jobs(
    data: Path, out: Path, config: TrainConfig, count: int, validation: Path | None, limit: int | None
) -> list[Job]:
    """`count` runs that differ in their seed, each in a folder `seed_N` of `out`."""
    jobs = []
    for seed in range(config.training.seed, config.training.seed + count):
        sections = config.replaced(training__seed=seed).plain()
        where = str(validation.absolute()) if validation else None
        jobs.append(Job(str(data.absolute()), str(out.absolute() / f"seed_{seed}"), sections, where, limit))
    return jobs


def unfinished(jobs: Iterable[Job]) -> list[Job]:
    """Those without a result; `FileExistsError` if a folder holds the result of another configuration."""
    left = []
    for job in jobs:
        if job.folder.finished:
            job.folder.check_same(job.config)
        else:
            left.append(job)
    return left


def run_processes(jobs: list[Job], processes: int, report: Callable[[Job, str], None]) -> None:
    """Run jobs in so many processes at a time; `report` gets each that ended, with its error or "".

    Ctrl-C ends the processes; the same jobs run again go on where they were.
    """
    waiting, running = list(jobs), dict[str, tuple[Job, subprocess.Popen[bytes]]]()
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                job = waiting.pop(0)
                running[job.out] = (job, _start(job, max(1, (os.cpu_count() or 1) // processes)))
            time.sleep(_POLL_SECONDS)
            for key, (job, process) in list(running.items()):
                if process.poll() is not None:
                    del running[key]
                    report(job, "" if process.returncode == 0 else _last_line(job))
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.wait()


def run_cluster(jobs: list[Job], scheduler: str, report: Callable[[Job, str], None]) -> None:
    """Run jobs on the workers of a Dask scheduler; their folders' files come back where they are not shared.

    Data and project have to be at the same paths on every machine.

    Raises `ClusterError` if Dask is not installed or the scheduler does not answer.
    """
    with cluster_client(scheduler) as client:
        from distributed import as_completed

        futures = {client.submit(run_on_worker, job, pure=False): job for job in jobs}
        for future in as_completed(futures):
            job = futures[future]
            failure = future.exception()
            if failure is None:
                store_files(job, future.result())
            report(job, "" if failure is None else str(failure))


def run_on_worker(job: Job) -> dict[str, bytes]:
    """Train in a process of its own (a worker may run several tasks at once); the run folder's files."""
    process = _start(job, threads=None)
    if process.wait() != 0:
        raise JobError(_last_line(job))
    files = Path(job.out).iterdir()
    return {path.name: path.read_bytes() for path in files if path.is_file() and path.name != STATE_NAME}


def main() -> int:
    """Train the job that comes as JSON on standard input."""
    from tactile_perception.training.train import train

    job = Job(**json.load(sys.stdin))
    try:
        train(job.data, job.out, job.config, job.validation, job.limit)
    except (ValueError, OSError, FloatingPointError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _start(job: Job, threads: int | None) -> subprocess.Popen[bytes]:
    """A process that trains one job and writes what it says to the run folder's log."""
    Path(job.out).mkdir(parents=True, exist_ok=True)
    environment = dict(os.environ)
    if threads is not None:
        environment.setdefault("OMP_NUM_THREADS", str(threads))
    with (Path(job.out) / LOG_NAME).open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "tactile_perception.training.jobs"],
            stdin=subprocess.PIPE,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
        )
    assert process.stdin is not None
    with process.stdin as pipe:
        pipe.write(json.dumps(dataclasses.asdict(job)).encode())
    return process


def store_files(job: Job, files: dict[str, bytes]) -> None:
    """Write files that came from a worker, unless its folder is ours; the result last, as it says "done"."""
    if job.folder.finished:
        return
    job.folder.path.mkdir(parents=True, exist_ok=True)
    for name in sorted(files, key=lambda name: name == RESULT_NAME):
        job.folder.file(name).write_bytes(files[name])


def _last_line(job: Job) -> str:
    path = Path(job.out) / LOG_NAME
    lines = path.read_text(errors="replace").strip().splitlines() if path.exists() else []
    return f"{job.out}: {lines[-1]}" if lines else f"{job.out}: ended without saying why"


if __name__ == "__main__":
    sys.exit(main())
