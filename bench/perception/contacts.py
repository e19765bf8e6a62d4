"""Errors of a network by the number of labelled contacts it was trained on, from several starts.

    python bench/perception/contacts.py DATA [--start sim=RUN sim=RUN:base] [--sizes 0 25 100] [--jobs 2]

A fifth of DATA (of the part for training where it has parts) is held out to measure on. Of the rest the
first N of a random order are taken, of which a fifth calibrates, and chooses the epoch where the loss does. A
start is the folder of a finished run of `tactile train`, and of its network `base` or `convolutions` stay as
they are where that is added (training.frozen); without --start networks start from random weights. Size 0 is
the start as it is. --vary names settings of one more network. With --folds as many networks are joined that
each leave out another part of the contacts, as by `tactile train --folds`, and with --informed besides, half
of the contacts are those, of all, about which networks of the other half disagree most. The start `plain` is
no start, but a plain network (plain_network.py). Rows that are done stay in OUT/rows.jsonl. Needs PyTorch
(`scripts/setup.sh train`).
"""

from __future__ import annotations

import argparse
import dataclasses
import pickle
import shutil
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

sys.path.extend(map(str, Path(__file__).resolve().parents[:2]))

from shared import Table, needs, parser

from tactile_base.config_paths import config_path
from tactile_base.jobs import JobRows, Workers, run_jobs
from tactile_base.whole_file import only_writer
from tactile_bringup.learning import PARTS
from tactile_perception.datasets.dataset import TactileDataset, read_dataset, training_part
from tactile_perception.estimating.contact_model import CONTACT_MODELS, POSE, ContactModel
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.plots import log_axis, plot_grid
from tactile_perception.evaluation.calibration import CalibrationSettings, fit_calibration
from tactile_perception.evaluation.models import predict_all

HELD_OUT = 5
SIZES = (0, 25, 50, 100, 200, 500, 1000, 2000, 6000)
FEWEST = 20  # samples to calibrate on
COMMITTEE = 3  # networks that may disagree
RANDOM, PLAIN = "random", "plain"


@dataclass(frozen=True)
class Job:
    """One training run."""

    data: str
    size: int
    start: str
    seed: int
    sections: dict[str, Any]
    run: str
    plain: bool
    folds: int = 1
    informed: bool = False

    @property
    def name(self) -> str:
        return f"{Path(self.data).stem} {self.start} {self.size} {self.seed}"


@dataclass(frozen=True)
class Network:
    """What it is asked by, what it tells, of how large images, and its epoch."""

    estimator: Any
    model: ContactModel
    size: int
    epoch: int = 0
    calibrated: bool = False

    @classmethod
    def of(cls, path: Path, epoch: int = 0) -> Network:
        """Of a model file."""
        estimator = Estimator(path)
        metadata = estimator.metadata
        return cls(estimator, metadata.contact_model, metadata.preprocessing.size, epoch)


@cache
def dataset(path: str) -> TactileDataset:
    """What `stored` left."""
    data, images = pickle.loads(Path(path).read_bytes())
    return dataclasses.replace(data, images=np.array([cv2.imdecode(image, -1) for image in images]))


def stored(folder: Path, out: Path, size: int) -> Path:
    """A data set in one file, at `size` pixels: many jobs read it."""
    path = out / str(size) / f"{folder.name}.pkl"
    if not path.exists():
        path.parent.mkdir(exist_ok=True)
        data = read_dataset(training_part(folder), changes={"size": size}, complete=False)
        images = [cv2.imencode(".png", image)[1] for image in data.images]
        path.write_bytes(pickle.dumps((dataclasses.replace(data, images=np.empty(0)), images)))
    return path


def taken(data: TactileDataset, rows: np.ndarray, size: int) -> TactileDataset:
    """Some samples, at `size` pixels."""
    from tactile_perception.training.data import reduced

    return dataclasses.replace(
        data,
        names=[data.names[row] for row in rows],
        images=reduced(data.images[rows], size),
        euler_mm_deg=data.euler_mm_deg[rows],
        force=data.force[rows],
    )


def parts(count: int, job: Job) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows to train on, to choose the epoch on, and to measure on."""
    test = np.arange(0, count, HELD_OUT)
    rows = np.random.default_rng(job.seed).permutation(np.setdiff1d(np.arange(count), test))
    pool = rows[: job.size]
    return pool[len(pool) // HELD_OUT :], pool[: len(pool) // HELD_OUT], test


def learned(
    job: Job, data: TactileDataset, learning: np.ndarray, choosing: np.ndarray | None = None
) -> Network:
    """A network of these rows; without others to choose by, of those that its settings do not hold back."""
    from tactile_perception.training.augmentation import SCALE
    from tactile_perception.training.config import TrainConfig
    from tactile_perception.training.data import arrange, load_start
    from tactile_perception.training.progress import TrainingProgress
    from tactile_perception.training.run_folder import RunFolder
    from tactile_perception.training.train import train_network

    config = TrainConfig.from_mapping(job.sections)
    size = config.network.image_size
    if job.plain:
        from plain_network import PlainNetwork

        model = CONTACT_MODELS.load(config.training.model).narrowed(data.labelled, job.data)
        samples = [taken(data, rows, size) for rows in (learning, choosing)]
        pairs = [(each.images, each.labels_for(model)) for each in samples]
        return Network(PlainNetwork(model, job.seed, *pairs), model, size)
    large = SCALE * size if config.augmentation.active else size
    preprocessing = data.preprocessing.replaced(size=size)
    validation = None if choosing is None else taken(data, choosing, size)
    ready = arrange(taken(data, learning, large), validation, config, preprocessing)
    if config.training.start:
        ready = ready.started(load_start(config.training.start, config.network))
    shutil.rmtree(job.run, ignore_errors=True)
    result = train_network(ready, RunFolder(job.run), config, TrainingProgress())
    return Network.of(result.model_path, result.best.number + 1)


def joined(job: Job, data: TactileDataset, rows: np.ndarray) -> Network:
    """Several networks of these rows that each leave out another part."""
    from tactile_perception.training.config import TrainConfig
    from tactile_perception.training.ensemble import write_folds
    from tactile_perception.training.jobs import fold_configs

    config, runs = TrainConfig.from_mapping(job.sections), []
    config = config.replaced(calibration__margin=(1.0,) * POSE, calibration__floor=(0.0,) * POSE)  # as below
    for fold, own in enumerate(fold_configs(config, job.folds)):
        runs.append(Path(f"{job.run} fold {fold}"))
        learned(dataclasses.replace(job, sections=own.plain(), run=str(runs[-1])), data, rows)
    path = Path(f"{job.run}.onnx")
    write_folds(runs, path, taken(data, rows, config.network.image_size))
    return dataclasses.replace(Network.of(path), calibrated=True)


def informed(job: Job, data: TactileDataset, rows: np.ndarray, test: np.ndarray) -> np.ndarray:
    """Half of these rows, and as many of all others about which networks of that half disagree most."""
    first, told = rows[::2], []
    pool = np.setdiff1d(np.arange(len(data)), [*first, *test])
    for seed in range(COMMITTEE):
        training = job.sections["training"] | {"seed": seed}
        own = dataclasses.replace(
            job, run=f"{job.run} {seed}", sections=job.sections | {"training": training}
        )
        network = learned(own, data, first, first)
        told.append(predict_all(network.estimator, taken(data, pool, network.size).images)[0])
    doubt = np.var(told, axis=0) / np.mean(told, axis=0).var(axis=0)  # in parts of what varies
    return np.concatenate([first, pool[np.argsort(doubt.mean(axis=1))[len(first) - len(rows) :]]])


def trained(job: Job) -> dict[str, Any]:
    """A row: errors and coverage on what was held out; the network is calibrated on what chose its epoch."""
    started = time.monotonic()
    data = dataset(job.data)
    learning, choosing, test = parts(len(data), job)
    if job.folds > 1 and job.size:
        rows = np.sort(np.concatenate([learning, choosing]))
        network = joined(job, data, informed(job, data, rows, test) if job.informed else rows)
    elif job.size:
        network = learned(job, data, learning, choosing)
    else:
        network = Network.of(Path(job.sections["training"]["start"]) / "model.onnx")
    model = network.model

    def answers(rows: np.ndarray) -> tuple[np.ndarray, ...]:
        samples = taken(data, rows, network.size)
        labels = samples.labels_for(model)
        mean, cov = predict_all(network.estimator, samples.images)
        return labels, mean, cov, model.error(mean, labels)

    labels, mean, cov, error = answers(test)
    if network.calibrated:
        cov = network.estimator.metadata.calibration.covariance(mean, cov)
    elif len(choosing) >= FEWEST:
        known, *found, off = answers(choosing)
        settings = CalibrationSettings(min_samples=FEWEST)
        cov = fit_calibration(known, *found, settings, off).covariance(mean, cov)
    within = np.where(np.isnan(error), np.nan, error**2 <= 1.96**2 * np.diagonal(cov, axis1=1, axis2=2))
    return {
        "name": job.name,
        "data": Path(job.data).stem,
        "start": job.start,
        "size": len(learning) + len(choosing),
        "seed": job.seed,
        "components": list(model.columns),
        "mae": np.abs(error).mean(axis=0).tolist(),
        "guess": np.abs(labels - np.median(labels, axis=0)).mean(axis=0).tolist(),
        "within 95 %": (100.0 * within.mean(axis=0)).tolist(),
        "epoch": network.epoch,
        "seconds": time.monotonic() - started,
    }


def job_of(
    given: argparse.Namespace, data: Path, size: int, start: str, changes: list[str], seed: int
) -> Job:
    """The training of a cell of the table."""
    from tactile_perception.training.config import TrainConfig

    config = TrainConfig.from_file(given.config)
    name, _, run = start.partition("=")
    if not run and name not in (RANDOM, PLAIN):
        raise SystemExit(f"--start {start}: must be {RANDOM}, {PLAIN} or NAME=RUN")
    run, _, frozen = run.partition(":")
    if run:
        config = config.replaced(
            training__start=str(Path(run).absolute()), training__frozen=frozen or "nothing"
        )
        name += f":{frozen}" if frozen else ""
    name += "".join(f" {change}" for change in changes)
    name += f" in {given.folds} folds" if given.folds > 1 else ""
    name += ", informed" if given.informed else ""
    config = config.changed([*given.set, *changes, f"training.seed={seed}", "training.holdback=0"])
    folder = given.out.absolute() / f"{data.stem} {name} {size} {seed}".replace("/", "_")
    more = start == PLAIN, given.folds, given.informed
    return Job(str(data.absolute()), size, name, seed, config.plain(), str(folder), *more)


def scaled(row: dict[str, Any], key: str) -> np.ndarray:
    """Errors in mm, degrees and N."""
    units = [180.0 / np.pi if name.endswith("_rad") else 1.0 for name in row["components"]]
    return np.array(units) * row[key]


def mean_of(row: dict[str, Any], key: str, columns: Sequence[int]) -> float:
    """Of what is labelled; NaN of nothing."""
    found = scaled(row, key)[[*columns]]
    return float(found[np.isfinite(found)].mean()) if np.isfinite(found).any() else np.nan


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Errors against contacts, a row of panels for each data set and a line for each start; gray: a guess."""
    names = list(dict.fromkeys(row["data"] for row in rows))
    ticks = [tick for tick in (0, 25, 100, 1000) if tick >= min(row["size"] for row in rows)]
    starts = list(dict.fromkeys(row["start"] for row in rows))
    figure, grid = plot_grid(len(names), len(PARTS), 2.4)
    for name, panels in zip(names, grid, strict=True):
        for axes, (what, (columns, unit)) in zip(panels, PARTS.items(), strict=True):
            for number, start in enumerate(starts):
                own = [row for row in rows if row["data"] == name and row["start"] == start]
                own.sort(key=lambda row: row["size"])
                errors = [mean_of(row, "mae", columns) for row in own]
                axes.plot([row["size"] for row in own], errors, "o-", color=f"C{number}", label=start)
                if own:
                    axes.axhline(mean_of(own[0], "guess", columns), color="0.7", zorder=0)
            axes.set_xscale("symlog", linthresh=25.0, linscale=0.5)  # from 0 on
            axes.set_xticks(ticks, [f"{tick}" for tick in ticks])
            if np.isfinite(axes.dataLim.get_points()).all():
                log_axis(axes, "y")
            axes.set(xlabel="contacts", ylabel=f"{what} ({unit})", title=name)
            axes.grid(alpha=0.3)
        panels[0].legend(loc="lower left", fontsize="small")
    figure.savefig(path, dpi=110)


def main() -> None:
    """Train what is missing, print all rows and draw them."""
    arguments = parser(__doc__ or "")
    add = arguments.add_argument
    add("data", type=Path, nargs="+")
    add("--out", type=Path, default=Path("out/contacts"))
    add("--config", type=Path, default=config_path("perception/gdn_symmetry.yaml"))
    add("--set", nargs="*", default=[], metavar="SECTION.NAME=VALUE", help="of all networks")
    add("--start", nargs="*", default=[RANDOM], metavar="NAME=RUN", help="or RUN:base, `random`, `plain`")
    add("--vary", nargs="*", action="append", metavar="SECTION.NAME=VALUE", help="of a further network each")
    add("--sizes", type=int, nargs="*", default=SIZES)
    add("--folds", type=int, default=1, metavar="N", help="networks that are joined")
    add("--informed", action="store_true", help="half where networks of the others disagree")
    add("--pixels", type=int, default=128, help="side at which images are kept: twice that of a network")
    add("--seeds", type=int, default=1)
    add("--jobs", type=int, default=1)
    add("--scheduler", default="", metavar="ADDRESS", help="of Dask, in place of --jobs")
    given = arguments.parse_args()
    needs("scripts/setup.sh train", "torch", "onnx")
    given.out.mkdir(parents=True, exist_ok=True)
    data = [stored(folder, given.out, given.pixels) for folder in given.data]
    jobs = [
        job_of(given, path, size, start, changes, seed)
        for seed in range(given.seeds)
        for size in sorted(given.sizes, reverse=True)
        for path in data
        for changes in given.vary or [[]]
        for start in given.start
        if size or start not in (RANDOM, PLAIN)  # of which there is nothing yet
    ]
    lock = only_writer(given.out)  # runs of the same names would write to the same folders
    rows = JobRows(given.out / "rows.jsonl")
    for done in run_jobs(trained, rows.missing(jobs), Workers(given.jobs, given.scheduler), print):
        print(done.job.name, done.error or "", flush=True)
        if done.value is not None:
            rows.add(done.value)
    lock.close()
    found = rows.of(jobs)
    table = Table(
        ("data", "start", "contacts", "seed", "errors (mm, deg, N)", "of a guess", "within 95 %"), "one run"
    )
    for row in found:
        errors, guess = (", ".join(f"{v:.3g}" for v in scaled(row, key)) for key in ("mae", "guess"))
        covered = row["within 95 %"]
        bands = f"{np.nanmin(covered):.0f} to {np.nanmax(covered):.0f} %"
        table.row(row["data"], row["start"], str(row["size"]), str(row["seed"]), errors, guess, bands)
    if found:
        draw(found, given.out / "contacts.png")


if __name__ == "__main__":
    import contacts  # jobs are sent to other processes, which know them by this name

    contacts.main()
