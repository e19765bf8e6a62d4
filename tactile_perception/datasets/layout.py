"""Names of the public data layout, and the report on a data folder."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

TARGETS_NAME = "targets_images.csv"
#: Names of the label table, the first that is there counts: tools write targets.csv with raw images.
TARGETS_NAMES = (TARGETS_NAME, "targets.csv", "labels.csv")
#: Which components are labelled, where it is not all six; `tactile data import` writes it.
LABELS_NAME = "labels.json"
#: What the data were made with.
PARAMETERS_NAME = "collect_params.json"
JOURNAL_NAME = "targets_images.partial.csv"
IMAGES_NAME = "processed_images"
RAW_IMAGES_NAME = "images"
IMAGE_FOLDERS = (IMAGES_NAME, RAW_IMAGES_NAME, "sensor_images")
IMAGE_PARAMS_NAME = "processed_image_params.json"
#: Where the settings of processed images and of the camera's may stand.
IMAGE_PARAMS_NAMES = (
    IMAGE_PARAMS_NAME,
    "process_image_params.json",
    "sensor_process_params.json",
    "image_params.json",
)
CAMERA_PARAMS_NAMES = ("sensor_image_params.json", "sensor_params.json")
#: Where the markers are in each camera image, (n, 2) column and row in a .npy, where a simulator knows it.
MARKERS_NAME = "markers"
SHARD_SUFFIX = ".parquet"
#: The image without contact, which has no row.
REFERENCE_NAME = "image_0.png"
AXES = ("x", "y", "z", "Rx", "Ry", "Rz")
POSE_COLUMNS = tuple(f"pose_{axis}" for axis in AXES)
SHEAR_COLUMNS = tuple(f"shear_{axis}" for axis in AXES)
FORCE_COLUMNS = ("Fx", "Fy", "Fz")
IMAGE_COLUMNS = ("sensor_image", "image_name")
#: Parts of a data set, and what tools call their folders.
PARTS = {"train": ("train", "train_data"), "val": ("val", "val_data"), "test": ("test", "test_data")}


class DatasetError(ValueError):
    """A folder that is not a data set, or one in which nothing is usable."""


@dataclass
class DatasetReport:
    """What was found in a data folder: how many samples are usable, and everything that is not, by name."""

    folder: Path
    rows: int = 0
    samples: int = 0
    #: what is wrong -> the names it is wrong with
    problems: dict[str, list[str]] = field(default_factory=dict)
    #: repairs and assumptions, one sentence each
    notes: list[str] = field(default_factory=list)

    def add(self, problem: str, name: str) -> None:
        self.problems.setdefault(problem, []).append(name)

    def lines(self, names: int = 5) -> list[str]:
        """The report as lines of text, with at most `names` names for each problem."""
        lines = [f"{self.folder}: {self.samples} usable samples of {self.rows} rows"]
        lines += [f"  note: {note}" for note in self.notes]
        for problem, which in self.problems.items():
            rest = f", and {len(which) - names} more" if len(which) > names else ""
            lines.append(f"  {problem}: {len(which)} ({', '.join(which[:names])}{rest})")
        return lines


def parts_of(folder: Path) -> dict[str, Path]:
    """The folders of the parts "train", "val" and "test" that a folder holds; empty where it has none."""
    found = {
        part: [folder / name for name in names if (folder / name).is_dir()] for part, names in PARTS.items()
    }
    return {part: folders[0] for part, folders in found.items() if folders}


def data_folders(folder: Path) -> dict[str, Path]:
    """A folder's parts by name; itself, by the name "", where it has a table or no parts."""
    table = any((folder / name).is_file() for name in (*TARGETS_NAMES, JOURNAL_NAME))
    return {"": folder} if table or is_sharded(folder) else parts_of(folder) or {"": folder}


def is_sharded(folder: Path) -> bool:
    """Whether a folder holds shards."""
    return folder.is_dir() and any(folder.glob(f"*{SHARD_SUFFIX}"))


def image_name(number: int) -> str:
    """File name of sample `number`, counted from 1."""
    return f"image_{number}.png"


def image_number(name: str) -> int:
    """Number of a sample from its file name; raises ValueError for another name."""
    stem = Path(name).stem
    if not stem.startswith("image_"):
        raise ValueError(f"{name}: is not named image_<number>")
    return int(stem[len("image_") :])
