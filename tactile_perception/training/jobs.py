"""Many training runs, as jobs that `tactile_base.jobs` runs; data are at the same paths on every machine."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tactile_perception.estimating.model_metadata import RESULT_NAME
from tactile_perception.training.config import TrainConfig
from tactile_perception.training.run_folder import STATE_NAME, RunFolder

LOG_NAME = "train.log"


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
    seeds = range(config.training.seed, config.training.seed + count)
    configs = {f"seed_{seed}": config.replaced(training__seed=seed) for seed in seeds}
    return _jobs(data, out, configs, validation, limit)


def fold_configs(config: TrainConfig, count: int) -> list[TrainConfig]:
    """Of `count` networks that each hold back another part of the data, and begin by another seed."""
    part, seed = 1.0 / count, config.training.seed
    return [
        config.replaced(training__holdback=part, training__fold=fold, training__seed=seed + fold)
        for fold in range(count)
    ]


def fold_jobs(data: Path, out: Path, config: TrainConfig, count: int, validation: Path | None) -> list[Job]:
    """Runs of `fold_configs`, in folders `fold_N` of `out`."""
    configs = {f"fold_{fold}": each for fold, each in enumerate(fold_configs(config, count))}
    return _jobs(data, out, configs, validation, None)


def _jobs(
    data: Path, out: Path, configs: Mapping[str, TrainConfig], validation: Path | None, limit: int | None
) -> list[Job]:
    """A run for each configuration, in a folder of that name."""
    where = str(validation.absolute()) if validation else None
    return [
        Job(str(data.absolute()), str(out.absolute() / name), config.plain(), where, limit)
        for name, config in configs.items()
    ]


def unfinished(jobs: Iterable[Job]) -> list[Job]:
    """Those without a result; `FileExistsError` if a folder holds the result of another configuration."""
    left = []
    for job in jobs:
        if job.folder.finished:
            job.folder.check_same(job.config)
        else:
            left.append(job)
    return left


def train_job(job: Job) -> dict[str, bytes]:
    """Train, with what is said of it in the run folder's log; the folder's files.

    Jobs that run side by side need a process each, as PyTorch's random numbers are the process's.
    """
    from tactile_perception.training.train import train

    job.folder.path.mkdir(parents=True, exist_ok=True)
    with job.folder.file(LOG_NAME).open("a") as log, redirect_stdout(log), redirect_stderr(log):
        train(job.data, job.out, job.config, job.validation, job.limit)
    files = job.folder.path.iterdir()
    return {path.name: path.read_bytes() for path in files if path.is_file() and path.name != STATE_NAME}


def store_files(job: Job, files: dict[str, bytes]) -> None:
    """Write files that came from a worker, unless its folder is ours; the result last, as it says "done"."""
    if job.folder.finished:
        return
    job.folder.path.mkdir(parents=True, exist_ok=True)
    for name in sorted(files, key=lambda name: name == RESULT_NAME):
        job.folder.file(name).write_bytes(files[name])
