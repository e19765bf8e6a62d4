"""`tactile data import`: brings data of other labs into our layout, and says what the images say of them."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from rich.console import Console

from tactile_base.console import say
from tactile_base.progress import Progress
from tactile_base.whole_file import check_folder, room_for_results
from tactile_bringup.commands.changes import add_command, positive_int
from tactile_bringup.commands.data_check import EXIT_CODES, show
from tactile_perception.datasets.check import check
from tactile_perception.datasets.dataset import TactileFolder
from tactile_perception.datasets.importing import check_outside, import_folder
from tactile_perception.datasets.layout import LABELS_NAME, TARGETS_NAME, DatasetError, data_folders
from tactile_perception.datasets.mapping import UnknownTable, read_mapping
from tactile_perception.datasets.sample_sheet import draw_samples
from tactile_perception.markers.flow import FlowSettings

TEMPLATE_NAME = "mapping.yaml"
SHEET_NAME = "samples.png"


def register(commands: Any) -> None:
    help = "bring another lab's data into our layout"
    add = add_command(commands, "import", run, __doc__, help=help, epilog=EXIT_CODES).add_argument
    add("folder", type=Path, help="their data folder, or one of parts (train, train_data, val, val_data)")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the imported data")
    add("--mapping", type=Path, metavar="FILE", help="which of their columns is what, if they are not known")
    text = "images in which markers are followed (1000)"
    add("--samples", type=positive_int, default=1000, metavar="N", help=text)


def run(arguments: argparse.Namespace) -> int:
    console = Console()
    if not arguments.folder.is_dir():
        raise DatasetError(f"{arguments.folder}: is not a folder")
    mapping = read_mapping(arguments.mapping) if arguments.mapping else None
    whole = mapping is not None and (arguments.folder / mapping.table).is_file()
    parts = {"": arguments.folder} if whole else data_folders(arguments.folder)
    check_outside(arguments.out, arguments.folder)
    inside = arguments.folder.resolve().is_relative_to(arguments.out.resolve())
    kept = arguments.folder if inside else arguments.mapping  # not to be put aside with earlier results
    room_for_results(arguments.out, TARGETS_NAME, f"*/{TARGETS_NAME}", source=kept)
    worst = 0
    for part, source in parts.items():
        out = arguments.out / part
        try:
            folder, said = import_folder(source, out, mapping)
        except UnknownTable as error:
            raise DatasetError(f"{error}. {_with_template(error, arguments.out)}") from error
        with Progress() as progress:
            result = check(folder, FlowSettings(samples=arguments.samples), progress.update)
        told = result.conventions
        camera = told.camera_deg if told and told.explanations and math.isfinite(told.camera_deg) else None
        draw_samples(folder, out / SHEET_NAME, camera)
        show(result, console)
        for line in _report(source, folder, said):
            say(console, line)
        worst = max(worst, int(result.worst == "error"))
    return worst


def _with_template(error: UnknownTable, out: Path) -> str:
    """Write a mapping file to be filled in, unless there is one; returns what to do with it."""
    path = out / TEMPLATE_NAME
    if not path.exists():
        check_folder(out)
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(error.template)
    return f"Fill in {path} and give it by --mapping"


def _report(source: Path, folder: TactileFolder, said: dict[str, Any]) -> list[str]:
    facts = said["images"]
    size = f" of {facts['width']}x{facts['height']}" if "width" in facts else ""
    circle = ", dark outside a circle" if facts.get("circular") else ""
    forces = ""
    if folder.forces:
        forces = f"; forces {', '.join(folder.forces)} in N (train on them with --model surface_force)"
    return [
        *(f"{source}: {note.strip()}" for note in said["notes"]),
        f"{source}: {len(folder)} samples imported to {folder.folder}",
        f"images: {facts['kind']}{size}{circle}, in {folder.image_folder.name}/",
        f"labelled: {', '.join(folder.labelled)}{forces}; stated in {folder.folder / LABELS_NAME}",
        f"look at {folder.folder / SHEET_NAME}: ten samples with their labels",
    ]
