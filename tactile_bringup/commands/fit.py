"""Fit a simulated sensor, or a model of a network's errors, to measured data."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from tactile_base.console import number_table
from tactile_base.whole_file import check_file, room_for_files
from tactile_bringup.commands.changes import add_command, add_group, natural_int, positive_int
from tactile_bringup.fitting.network_error import Ways, compared, drawn, fit
from tactile_bringup.fitting.sensor import PARAMETERS, Fit, by_depth, improve, loss, write
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.labels import COMPONENTS
from tactile_perception.markers.labelled import Tracked, track
from tactile_sim.collection import SensorFile, load_sensor


def register(subparsers: Any) -> None:
    commands = add_group(subparsers, "fit", __doc__)
    _register_sensor(commands)
    _register_network_error(commands)


def _register_sensor(commands: Any) -> None:
    help = "a simulated TacTip from a real one's labelled images"
    add = add_command(commands, "sensor", run_fit_sensor, help=help, status=1).add_argument
    add("data", type=Path, help="labelled folder of the public layout")
    add("--out", type=Path, required=True, metavar="FILE", help="sensor file to write (.yaml)")
    add("--start", metavar="SENSOR", help="sensor, by name or file, to start from (default: built in)")
    add("--contacts", type=positive_int, default=180, help="images fitted (default 180)")
    add("--tracked", type=positive_int, default=2000, help="images in which markers are tracked (2000)")
    add("--iterations", type=natural_int, default=10, help="at most (default 10; 0: only --check)")
    add("--check", type=Path, metavar="DATA", help="tell the errors on these images, which are not fitted to")
    add("--seed", type=natural_int, default=1, help="of the choice of contacts")


def _register_network_error(commands: Any) -> None:
    help = "how a network errs on simulated images"
    add = add_command(commands, "network-error", run_fit_network_error, help=help, status=1).add_argument
    add("--out", type=Path, required=True, metavar="FILE", help="where the model goes (.npz)")
    add("--model", default="", help="ONNX model (default: the shipped one)")
    add("--contacts", type=positive_int, default=400, help="to fit to (default 400)")
    add("--held-out", type=positive_int, default=100, help="to check with (default 100)")


def run_fit_sensor(arguments: argparse.Namespace) -> int:
    """Fit camera, markers, skin, friction and the rig's errors of the simulated TacTip to labelled images.

    Fitted are the markers: about two minutes an iteration with 180 contacts on one core. The sensor file is
    written after every iteration; --start goes on from one.
    """
    check_file(arguments.out)
    room_for_files(arguments.out)
    sensor = load_sensor(arguments.start) if arguments.start else SensorFile()
    tracked = _tracked(arguments.data, arguments.tracked)
    chosen = tracked.some(arguments.contacts, arguments.seed)
    if not len(chosen):
        count = len(tracked.labels)
        raise ValueError(f"{arguments.data}: in none of {count} images 96 % of the markers are found")
    note = f"Fitted to {len(chosen)} contacts of {arguments.data} by tactile fit sensor"
    fit, damping = Fit(tracked, chosen, sensor), 1e-3
    cost = loss(fit.residual(sensor))
    for number in range(arguments.iterations):
        sensor, new, damping = improve(fit, sensor, damping)
        left = np.linalg.norm(fit.residual(sensor), axis=1)
        rms, median = np.sqrt(np.mean(left**2)), np.median(left)
        print(f"{number + 1}: loss {cost:.0f} -> {new:.0f}; left: RMS {rms:.2f} px, median {median:.2f} px")
        write(sensor, arguments.out, note)
        done, cost = cost - new < 2e-3 * cost, new
        if done:
            break
    table = number_table("what was fitted", ["", "fitted", "built in"])
    for parameter in PARAMETERS:
        table.add_row(parameter.name, f"{parameter.of(sensor):.5g}", f"{parameter.of(SensorFile()):g}")
    Console().print(table)
    if arguments.check:
        _check(arguments, sensor)
    return 0


def _tracked(folder: Path, count: int) -> Tracked:
    """Markers of up to so many of a folder's images, chosen at random."""
    data = open_folder(folder)
    rows = np.random.default_rng(0).choice(len(data), min(count, len(data)), replace=False)
    return track(data, np.sort(rows))


def _check(arguments: argparse.Namespace, sensor: Any) -> None:
    """Errors of the markers on contacts that were not fitted to, by depth."""
    others = _tracked(arguments.check, arguments.tracked)
    fit = Fit(others, others.some(arguments.contacts, arguments.seed, least_found=0.0), sensor)
    table = number_table(f"markers on {arguments.check}, px", ["depth", "contacts", "median", "RMS"])
    for name, count, median, rms in by_depth(fit, sensor):
        table.add_row(name, str(count), f"{median:.2f}", f"{rms:.2f}")
    Console().print(table)


def run_fit_network_error(arguments: argparse.Namespace) -> int:
    """Fit how a network errs along ways in contact, for sensors of fidelity 'fitted'.

    The model is compared with the network on contacts held out (about four minutes of one core).
    """
    check_file(arguments.out)
    room_for_files(arguments.out)
    estimator = Estimator(arguments.model)
    data = Ways(estimator, full=False).contacts(range(arguments.contacts))
    held = Ways(estimator, full=True).contacts(range(10**6, 10**6 + arguments.held_out))
    model = fit(data, held)
    model.save(arguments.out, made_by="tactile fit network-error", network=estimator.path.name)
    title = f"{len(held.error)} exposures held out, mm and degrees; {len(data.error)} fitted to"
    table = number_table(title, ["", "of", *COMPONENTS])
    for name, who, numbers in compared(held, drawn(model, held, seed=1)):
        table.add_row(name, who, *(f"{value:.3f}" for value in numbers))
    console = Console()
    console.print(table)
    for name, nees in (("network", held.nees), ("model", drawn(model, held, seed=1).nees)):
        print(f"NEES of 6, {name}: mean {nees.mean():.1f}")
    print(f"model: {arguments.out}")
    return 0
