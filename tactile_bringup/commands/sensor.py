"""The command `tactile sensor learn`: from a sensor in the hand to a network that keeps a promise."""

from __future__ import annotations

import argparse
import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.config_paths import config_path
from tactile_base.console import lasting_console, say
from tactile_base.settings import SettingError, unknown_name
from tactile_base.whole_file import check_folder, copy_whole
from tactile_bringup import learning
from tactile_bringup.commands import data_check, data_collect
from tactile_bringup.commands.changes import add_command, add_group, add_set_option, natural_int, positive_int
from tactile_bringup.commands.launch import add_rehearse_option
from tactile_perception.datasets.check import check
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.estimating.contact_model import CONTACT_MODELS, ContactModel
from tactile_perception.estimating.model_metadata import MODEL_NAME
from tactile_perception.markers.flow import FlowSettings
from tactile_perception.training.config import TrainConfig
from tactile_records.collecting.settings import DataCollectionSettings
from tactile_scene.scene_file import load_scene

NOT_KEPT = 3
EXIT_CODES = (
    "exit codes: 0 the promise is kept; 1 there is no network; 3 the promise is not kept, with all contacts "
    "made; others as of `tactile launch`"
)
CONTACTS = (125, 250, 500, 1000, 2000)
FOLDS = 5  # a fifth of 100 is what calibrates a network at least
PROMISE, EDGE_PROMISE = ("depth=0.3", "tilt=2"), ("depth=0.3", "offset=0.5", "direction=5")
EDGE_MODEL, FORCE_MODEL = "training.model=edge", "training.model=surface_force"
CONFIG = "perception/few_contacts.yaml"
SECONDS, EDGE_SECONDS = 2.5, 3.5  # of a contact in simulation


def register(subparsers: Any) -> None:
    commands = add_group(subparsers, "sensor", __doc__)
    text = "contacts and networks in rounds, until errors on contacts held back are small enough"
    parser = add_command(commands, "learn", run, help=text, epilog=EXIT_CODES, status=1)
    add = parser.add_argument
    add("out", type=Path, help="folder for contacts, networks and the page; the same command goes on there")
    add("--scene", default="plane", metavar="NAME", help="scene, or a scene file (plane)")
    text = (
        "mean absolute errors to come below, of depth (mm), tilt (deg), shear (mm), twist (deg) "
        f"({' '.join(PROMISE)}); on an edge of depth, tilt, offset (mm), direction (deg) "
        f"({' '.join(EDGE_PROMISE)})"
    )
    add("--promise", nargs="+", metavar="NAME=VALUE", help=text)
    text = f"contacts in all after each round, a fifth held back ({' '.join(map(str, CONTACTS))})"
    add("--contacts", type=positive_int, nargs="+", default=CONTACTS, metavar="N", help=text)
    add("--config", type=Path, help="of the networks, as of `tactile train` (few_contacts.yaml)")
    add("--start", type=Path, metavar="RUN", help="begin each network with that of a finished run")
    add_set_option(parser, "of the networks or of the collection, by section", "SECTION.NAME=VALUE")
    add("--collection", type=Path, metavar="FILE", help="settings of the collection (docs/data.md)")
    text = f"a round's networks, each without another part, joined in one model ({FOLDS}); 1: one network"
    add("--folds", type=positive_int, default=FOLDS, metavar="N", help=text)
    add("--arm", metavar="NAME", help="which arm (default: the one with a camera)")
    add("--surface", metavar="NAME", help="which surface (default: the only plane)")
    data_collect.add_edge_option(parser)
    text = "find the surface first: 1 touch for its height, 3 and more for its tilt too (3)"
    add("--touch", type=natural_int, default=3, metavar="N", help=text)
    add("--seed", type=natural_int, default=0, help="of the contacts (0)")
    add("--rate", type=float, metavar="HZ", help="simulated exposures a second")
    add_rehearse_option(parser)
    add("--headless", action="store_true", help="plain lines in place of the live display")


def run(arguments: argparse.Namespace) -> int:
    """Have the arm make contacts in rounds, train a network of each, and stop once it is good enough.

    Needs PyTorch (the extra 'train'). Contacts are made as by `tactile data collect`, a fifth of them only to
    judge by; where the scene has a force sensor the network tells forces, too. An interruption costs one
    contact, or one epoch: the same command goes on.
    """
    from tactile_bringup import learning_page

    console = lasting_console()
    words, model = _checked(arguments)
    promised = arguments.promise or (EDGE_PROMISE if arguments.edge else PROMISE)
    promise = learning.Promise.parse(promised, learning.parts_of(model))
    hour = 3600.0 / (EDGE_SECONDS if arguments.edge else SECONDS)  # in contacts
    hours = arguments.contacts[0] / hour, arguments.contacts[-1] / hour
    say(
        console,
        f"the arm presses and shears the sensor on {'an edge' if arguments.edge else 'a flat surface'}: "
        f"{arguments.contacts[0]} to "
        f"{arguments.contacts[-1]} contacts, {hours[0]:.1f} to {hours[1]:.1f} hours in simulation, until "
        f"{promise}, for sure",
    )
    learner = learning.Learning(
        arguments.out,
        arguments.contacts,
        promise,
        _collector(arguments, console),
        words,
        lambda line: say(console, line),
    )
    try:
        found = learner.run()
    except learning.LearningError as error:
        raise ValueError(str(error)) from error
    except KeyboardInterrupt:
        say(console, "interrupted; the same command goes on from here")
        return 130
    if not found:
        return learner.exit_code
    best = min(found, key=lambda judged: _shortfall(judged, promise))
    run_folder = next(chosen.run for chosen in learner.rounds if chosen.total == best.contacts)
    model = arguments.out / MODEL_NAME
    copy_whole(run_folder / MODEL_NAME, model)
    pages = learning_page.write(arguments.out, found, best, run_folder, promise)
    kept = promise.kept_by(best)
    verdict, color = ("kept", "green") if kept else ("not kept", "yellow")
    say(console, f"the promise is {verdict}: {best.line()}", color)
    say(console, f"model: {model} (in the scene: sensor: {{model: {model}}})\npage: {pages[0]}")
    return 0 if kept else learner.exit_code or NOT_KEPT


def _shortfall(judged: Any, promise: Any) -> float:
    """The largest error over what was promised of it."""
    ratios = [judged.errors[name][0] / most for name, most in promise.errors.items() if name in judged.errors]
    return max(ratios, default=math.inf)


def _checked(arguments: argparse.Namespace) -> tuple[list[str], ContactModel]:
    """Options of `tactile train`, and what its networks tell.

    Raises where something cannot be, before an arm moves.
    """
    if importlib.util.find_spec("torch") is None:
        raise ModuleNotFoundError("No module named 'torch'", name="torch")
    check_folder(arguments.out)
    config = arguments.config or config_path(CONFIG)
    networks, collection = TrainConfig().group_names(), DataCollectionSettings().group_names()
    for change in arguments.changes:
        section = change.partition(".")[0]
        if section not in (*networks, *collection):
            raise SettingError(f"--set {change}: {unknown_name(section, [*networks, *collection])}")
    own = [each for each in arguments.changes if each.partition(".")[0] in networks]
    scene = load_scene(arguments.scene)
    collecting = data_collect.defaults(
        data_collect.sensing_arm(scene, arguments.arm), arguments.touch, arguments.edge
    )
    others = [each for each in arguments.changes if each not in own]
    measured = data_collect.chosen_settings(collecting, arguments.collection, others).force.labelled
    changes = [*([EDGE_MODEL] if arguments.edge else [FORCE_MODEL] * measured), *own]
    chosen = TrainConfig.from_file(config).changed(changes)
    if arguments.folds > 1 and chosen.training.holdback:
        chosen = chosen.replaced(training__holdback=1.0 / arguments.folds)
    _check_rounds(list(arguments.contacts), chosen)
    model = CONTACT_MODELS.load(chosen.training.model)
    if model.forces and not measured:
        raise SettingError(
            f"training.model = {chosen.training.model}: tells forces, and no force sensor measures any in "
            f"{scene.path} (sensor: {{force_sensor: true}})"
        )
    words = ["--start", str(arguments.start.absolute())] if arguments.start else []
    words += ["--folds", str(arguments.folds)] if arguments.folds > 1 else []
    words = ["--config", str(config), *words, *(word for each in changes for word in ("--set", each))]
    return words, model


def _check_rounds(totals: list[int], config: TrainConfig) -> None:
    """`ValueError` where the first network could not be chosen or calibrated."""
    part, fewest = config.training.holdback, config.calibration.min_samples
    if not part:
        raise SettingError("training.holdback = 0: must be above 0, for there is no other data to choose on")
    least = math.ceil(math.ceil(fewest / part) * learning.HELD_BACK / (learning.HELD_BACK - 1))
    if totals != sorted(set(totals)) or totals[0] < least:
        raise ValueError(
            f"--contacts {' '.join(map(str, totals))}: must grow, from at least {least} on: a fifth is held "
            f"back to judge by, and {part:g} of the rest, which calibrates, has to be {fewest} and more"
        )


def _collector(
    arguments: argparse.Namespace, console: Console
) -> Callable[[Path, int, bool, Callable[[], bool]], int]:
    """What makes contacts, as `tactile data collect` does."""
    parser = argparse.ArgumentParser()
    data_collect.register(parser.add_subparsers())
    networks = TrainConfig().group_names()
    words = ["--scene", arguments.scene, "--seed", arguments.seed, "--touch", arguments.touch]
    optional = {"arm": arguments.arm, "surface": arguments.surface, "config": arguments.collection,
                "rate": arguments.rate}  # fmt: skip
    words += [word for name, value in optional.items() if value is not None for word in (f"--{name}", value)]
    words += [f"--{name}" for name in ("edge", "rehearse", "headless") if getattr(arguments, name)]
    for change in arguments.changes:
        words += ["--set", change] if change.partition(".")[0] not in networks else []

    def collect(folder: Path, count: int, validation: bool, enough: Callable[[], bool]) -> int:
        given = ["collect", folder, "--samples", count, *words, *["--validation"] * validation]
        asked = parser.parse_args([str(word) for word in given])
        code = data_collect.collected(asked, console, enough)
        if not code and not validation and count <= arguments.contacts[0]:
            _check_labels(folder, console)
        return code

    return collect


def _check_labels(folder: Path, console: Console) -> None:
    """Say what is wrong with the first contacts; `ValueError` where it is the labels or images themselves."""
    result = check(open_folder(folder), FlowSettings())
    for finding in result.findings:
        if finding.level in ("warning", "error"):
            text = f"{finding.level}: {finding.topic}: {finding.text}"
            say(console, text, data_check.STYLES[finding.level])
    if result.worst == "error":
        raise ValueError(f"{folder}: a network would learn what is wrong; `tactile data check` shows it")
