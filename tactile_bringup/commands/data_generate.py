"""Press and shear the simulated TacTip as the paper does; write OUT/train and OUT/val in the public layout.

The same command goes on after an interruption; a sample depends on seed and number only.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from tactile_base.config_paths import named_file
from tactile_base.console import say
from tactile_base.jobs import run_jobs
from tactile_base.progress import Progress, duration
from tactile_base.settings import SettingError
from tactile_base.whole_file import check_folder
from tactile_base.yaml_file import read_yaml
from tactile_bringup.commands.changes import (
    add_command,
    add_job_options,
    add_set_option,
    changed_settings,
    natural_int,
    positive_int,
    workers_of,
)
from tactile_perception.datasets.layout import FORCE_COLUMNS
from tactile_perception.datasets.writer import DatasetWriter, as_png, write_markers, write_processed
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_records.collecting.parameters import check_same_run
from tactile_scene.sampling import ON_EDGES, VALIDATION_START, EdgeSampling
from tactile_sim.collection import CollectionSettings, Collector, SensorFile, load_sensor
from tactile_sim.tactip import TacTip
from tactile_sim.variation import other_sensors


def register(commands: Any) -> None:
    help = "labelled images of the simulated TacTip"
    parser = add_command(commands, "generate", run_generate, __doc__, help=help, status=1)
    add = parser.add_argument
    add("out", type=Path, help="folder for train/ and val/")
    add("--train", type=natural_int, metavar="N", help="training samples (6000; none with --val alone)")
    add("--val", type=natural_int, metavar="N", help="validation samples (2000; none with --train alone)")
    add("--seed", type=natural_int, default=0)
    add_job_options(parser)
    add("--sensor", metavar="NAME", help="one of config/sensors, or a file (default: the built-in sensor)")
    text = "take turns with N - 1 more of its kind, of other gel, pins and lens: for a start on other sensors"
    add("--sensors", type=positive_int, default=1, metavar="N", help=text)
    text = "keep where the markers are in each image, for networks that lay them back"
    add("--markers", action="store_true", help=text)
    text = "on the edge of a plate in place of its face: deeper, and less sheared and tilted"
    add("--edge", action="store_true", help=text)
    add("--config", type=Path, help="YAML file with collection settings (SI)")
    add_set_option(parser, "change one of them; on an edge also edge.offset (m) and edge.direction (rad)")


def run_generate(arguments: argparse.Namespace) -> int:
    console = Console(stderr=True)
    try:
        check_folder(arguments.out)
        sensor = load_sensor(arguments.sensor) if arguments.sensor else SensorFile()
        preprocessing = _preprocessing(arguments.sensor)
        settings, edge = _settings(arguments, sensor.collection)
        wanted = {"train": (arguments.train, 0), "val": (arguments.val, VALIDATION_START)}
        if arguments.train is None and arguments.val is None:
            wanted = {"train": (6000, 0), "val": (2000, VALIDATION_START)}
        for name, (count, start) in wanted.items():
            if count:
                _generate_split(arguments, sensor, preprocessing, settings, edge, name, count, start, console)
    except KeyboardInterrupt:
        console.print("interrupted; the same command goes on from here")
        return 130
    return 0


def _settings(
    arguments: argparse.Namespace, settings: CollectionSettings
) -> tuple[CollectionSettings, EdgeSampling | None]:
    """Collection settings from the sensor's file, the given file and the command line, the last one first."""
    if arguments.edge:
        settings = settings.replaced(**ON_EDGES)
    if arguments.config:
        root = read_yaml(arguments.config)
        settings = root.checked(CollectionSettings, {**dataclasses.asdict(settings), **root.values})
    changes = changed_settings(arguments.changes, "cap_angle=0.3")
    if not arguments.edge:
        return settings.replaced(**changes), None
    of_edge = {
        name.removeprefix("edge."): changes.pop(name) for name in list(changes) if name.startswith("edge.")
    }
    settings = settings.replaced(**changes)
    if any(settings.curvature):
        raise SettingError(f"curvature = {settings.curvature}: a plate with an edge is flat; must be (0, 0)")
    return settings, EdgeSampling.from_mapping(of_edge)


def _preprocessing(sensor: str | None) -> PreprocessingSettings:
    """What a sensor's file says of the pre-processing of its images; without one, the default."""
    if not sensor:
        return PreprocessingSettings()
    return read_yaml(named_file("sensor", sensor)).settings("preprocessing", PreprocessingSettings)


def _generate_split(
    arguments: argparse.Namespace,
    sensor: SensorFile,
    preprocessing: PreprocessingSettings,
    settings: CollectionSettings,
    edge: EdgeSampling | None,
    name: str,
    count: int,
    start: int,
    console: Console,
) -> None:
    folder = arguments.out / name
    parameters = {"robot": "sim", "seed": arguments.seed, **dataclasses.asdict(settings)}
    parameters["sensor"] = dataclasses.asdict(sensor.sensor)
    if edge is not None:
        parameters["edge"] = dataclasses.asdict(edge)
    if sensor.variation is not None:
        parameters["variation"] = dataclasses.asdict(sensor.variation)
    if arguments.sensors > 1:
        parameters["sensors"] = arguments.sensors
    if arguments.markers:
        parameters["markers"] = True
    if preprocessing != PreprocessingSettings():
        parameters["preprocessing"] = dataclasses.asdict(preprocessing)
    check_same_run(folder, parameters)
    started = time.monotonic()
    with DatasetWriter(folder, preprocessing, extra=FORCE_COLUMNS) as writer:
        missing = sorted(set(range(1, count + 1)) - writer.done)
        if preprocessing.difference or edge is not None:  # where each contact hides half of the markers
            writer.add_image(0, TacTip(sensor.sensor, arguments.seed).image())
        sensors = other_sensors(sensor.sensor, arguments.sensors, arguments.seed)
        collector = Collector(settings, arguments.seed, sensors, sensor.variation, edge)
        work = ProcessedSample(collector, preprocessing, start)
        with Progress(console) as progress:
            samples = run_jobs(work, missing, workers_of(arguments), progress.say)
            for sample in progress.counted(samples, name, len(missing), "samples"):
                png, euler_mm_deg, force, markers = sample.result()
                write_processed(folder, sample.job, png)
                if arguments.markers:
                    write_markers(folder, sample.job, markers)
                writer.add_row(sample.job, euler_mm_deg, dict(zip(FORCE_COLUMNS, force, strict=True)))
        path, there = writer.finish(), len(writer.done)
    took = duration(time.monotonic() - started)
    say(console, f"{path}: {there} samples, {len(missing)} new in {took}")


@dataclass(frozen=True)
class ProcessedSample:
    """Makes the sample of a number: its image as it is stored, pose (6,), force (3,) and markers (n, 2)."""

    collector: Collector
    preprocessing: PreprocessingSettings
    start: int  # index of number 1

    def __call__(self, number: int) -> tuple[bytes, list[float], list[float], NDArray[np.float64]]:
        sample = self.collector(self.start + number - 1)
        png = as_png(Preprocessor(self.preprocessing).processed(sample.image))
        return png, sample.euler_mm_deg.tolist(), sample.truth.force.tolist(), sample.markers
