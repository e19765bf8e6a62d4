"""Brings a data folder of another lab into our layout: table, images by link, which labels there are.

    folder, said = import_folder(Path("theirs/train_data"), Path("out/theirs/train"), mapping=None)

The source is never written to. Images are hard links to its files, copies where a link is not possible.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base.whole_file import whole_file, write_csv
from tactile_perception.datasets import layout
from tactile_perception.datasets.dataset import TactileFolder, open_folder
from tactile_perception.datasets.layout import DatasetError
from tactile_perception.datasets.mapping import TableMapping
from tactile_perception.datasets.shards import ShardedFolder
from tactile_perception.datasets.table import CONVENTIONS_NAME
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.labels import EULER_COMPONENTS

_PROBES = 9
_DARK = 0.02  # of the brightest pixel, up to which the corners of an image count as masked


def import_folder(
    source: Path, out: Path, mapping: TableMapping | None = None
) -> tuple[TactileFolder, dict[str, Any]]:
    """Write the data of `source` to `out`; gives the folder as read from there, and its `labels.json`.

    What `conventions.json` of the source says is applied. Raises `DatasetError` if the source cannot be read
    as a data set, or `out` lies in it.
    """
    check_outside(out, source)
    folder = open_folder(source, mapping=mapping)
    if isinstance(folder, ShardedFolder):
        raise DatasetError(f"{source}: holds shards, which every command reads as they are")
    images = out / (layout.IMAGES_NAME if folder.processed else layout.RAW_IMAGES_NAME)
    images.mkdir(parents=True, exist_ok=True)
    names = flat_names(folder.names)
    files = zip(folder.names, names, strict=True)
    linked = sum(_bring(folder.image_folder / old, images / new) for old, new in files)
    reference = folder.image_folder / layout.REFERENCE_NAME
    if folder.reference() is not None and layout.REFERENCE_NAME not in names:
        _bring(reference, images / layout.REFERENCE_NAME)
    for name, content in folder.parameters.items():
        if name not in (CONVENTIONS_NAME, layout.LABELS_NAME):
            _write_json(out / name, content)
    forces = _write_table(folder, names, out / layout.TARGETS_NAME)
    said = {
        "components": folder.labelled,
        "forces": forces,
        "source": str(source.resolve()),
        "mapping": asdict(mapping) if mapping else None,
        "images": image_facts(folder),
        "linked": linked,
        "notes": [*folder.report.notes, *folder.report.lines()[1 + len(folder.report.notes) :]],
    }
    _write_json(out / layout.LABELS_NAME, said)
    return open_folder(out), said


def check_outside(out: Path, source: Path) -> None:
    """`DatasetError` if `out` lies in the source."""
    if out.resolve().is_relative_to(source.resolve()):
        raise DatasetError(f"{out}: lies in {source}, which is left as it is; name a folder elsewhere")


def flat_names(names: Sequence[str]) -> list[str]:
    """Names of files in one folder, for paths: their last parts, or all where these are not different."""
    plain = [Path(name).name for name in names]
    count = Counter(plain)
    flat = [
        short if count[short] == 1 else re.sub(r"[^\w.-]+", "_", name.replace("..", "")).strip("_")
        for short, name in zip(plain, names, strict=True)
    ]
    return flat if len(set(flat)) == len(flat) else [f"{k}_{short}" for k, short in enumerate(plain)]


def image_facts(folder: TactileFolder) -> dict[str, Any]:
    """What the images are: size, binary, gray or color, and whether they are dark outside a circle."""
    kind = folder.kind
    if kind is None:
        return {"kind": "of several sizes or kinds"}
    corners, brightest = [], 1
    for index in np.unique(np.linspace(0, len(folder) - 1, min(_PROBES, len(folder))).astype(int)).tolist():
        try:
            image = folder.image(index)
        except ImageError:
            continue  # named by whoever reads it as a sample
        rows, columns = np.indices(image.shape)
        middle = (np.array(image.shape) - 1) / 2
        outside = np.hypot(rows - middle[0], columns - middle[1]) > max(image.shape) / 2
        corners.append(int(image[outside].max(initial=0)))
        brightest = max(brightest, int(image.max()))
    return {
        "kind": "binary" if kind.binary else "gray" if kind.channels == 1 else "color, read as gray",
        "width": kind.shape[1],
        "height": kind.shape[0],
        "circular": bool(corners) and max(corners) <= _DARK * brightest,
    }


def _bring(source: Path, target: Path) -> bool:
    """Make `target` the same file as `source`, or a copy; whether it is the same."""
    target.unlink(missing_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:  # another disk, or one without links
        shutil.copyfile(source, target)
        return False
    return True


def _write_table(folder: TactileFolder, names: Sequence[str], path: Path) -> list[str]:
    """The label table, with columns for what is labelled alone; gives the forces that it has."""
    chosen = [k for k, name in enumerate(EULER_COMPONENTS) if name in folder.labelled]
    forces = [k for k, name in enumerate(layout.FORCE_COLUMNS) if name in folder.forces]
    header = [layout.POSE_COLUMNS[k] for k in chosen] + [layout.SHEAR_COLUMNS[k] for k in chosen]
    header += [layout.FORCE_COLUMNS[k] for k in forces]
    numbers = np.hstack([folder.pose[:, chosen], folder.shear[:, chosen], folder.force[:, forces]])
    rows = ([name, *map(repr, values)] for name, values in zip(names, numbers.tolist(), strict=True))
    write_csv(path, ["sensor_image", *header], rows)
    return [layout.FORCE_COLUMNS[k] for k in forces]


def _write_json(path: Path, content: Any) -> None:
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")
