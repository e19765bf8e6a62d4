"""Wrong commands end with a sentence that says what and where, and leave nothing behind."""

import re
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from folders import write_folder

from tactile_bringup.cli import main as tactile


def folder_of_noise(path: Path, count: int) -> Path:
    rng = np.random.default_rng(count)
    samples = (
        (rng.integers(0, 255, (480, 640), dtype=np.uint8), rng.uniform(0.5, 5.0, 6)) for _ in range(count)
    )
    return write_folder(path, samples)


def spoil_table(text: str) -> Callable[[Path], object]:
    return lambda folder: (folder / "targets_images.csv").write_text(text)


def spoil_images(content: bytes | None) -> Callable[[Path], object]:
    def spoil(folder: Path) -> None:
        for image in (folder / "processed_images").iterdir():
            image.unlink()
            if content is not None:
                image.write_bytes(content)

    return spoil


def spoil_labels(folder: Path) -> None:
    table = folder / "targets_images.csv"
    head, *rows = table.read_text().splitlines()
    rows = [",".join([row.split(",")[0], *(["nan"] * 12)]) for row in rows]
    table.write_text("\n".join([head, *rows]) + "\n")


SPOILED = {
    "empty": spoil_table(""),
    "columns": spoil_table("a,b\n1,2\n"),
    "labels": spoil_labels,
    "no_images": spoil_images(None),
    "cut": spoil_images(b"\x89PNG\r\n\x1a\nrubbish"),
    "huge": spoil_images(
        b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
        + 2 * b"\x7f\xff\xff\xff"
        + b"\x08\0\0\0\0\0\0\0\0IEND\xaeB`\x82"
    ),
}


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """A folder with data, data that are spoiled in one way each, and files that are nothing."""
    folder = tmp_path_factory.mktemp("usage")
    folder_of_noise(folder / "d" / "train", 3)
    folder_of_noise(folder / "d" / "val", 2)
    for name, spoil in SPOILED.items():
        spoil(folder_of_noise(folder / name, 2))
    (folder / "file").write_text("nothing")
    (folder / "bad.onnx").write_text("nothing")
    (folder / "bad.yaml").write_text("network: [1\n")
    (folder / "empty.png").write_bytes(b"")
    cv2.imwrite(str(folder / "gray.png"), np.zeros((48, 64), np.uint8))
    return folder


DATA = [  # what is wrong with a data folder, whoever reads it
    ("nowhere", "nowhere: "),
    ("file", "file: "),
    ("empty", "empty/targets_images.csv: has no column .*; its columns: none"),
    ("columns", "its columns: a, b"),
    ("labels", "row with a non-finite label: 2"),
    ("no_images", "row without its image: 2"),
    ("cut", r"unusable image: 2 \(cut/processed_images/image_1.png: is not a readable image"),
    ("huge", r"unusable image: 2 \(huge/processed_images/image_1.png: is not a readable image"),
]
TRAIN = "train d --out new --set network.image_size=16 --set network.channels=[4,4]"
WRONG = [
    *((f"train {name} --val d/val --out new", message) for name, message in DATA),
    *((f"evaluate --data {name} --model MODEL --out new", message) for name, message in DATA),
    ("train d/train --out new", "name the validation data with --val"),
    ("train d --out file", "file: cannot be a folder, since .*file is a file"),
    (f"{TRAIN} --limit 0", "argument --limit: 0: must be a whole number from 1 on"),
    (f"{TRAIN} --limit 1", "1 samples, needs at least 2"),
    (f"{TRAIN} --repeat 0", "argument --repeat: 0: must be a whole number from 1 on"),
    (f"{TRAIN} --jobs two", "argument --jobs: two: must be a whole number"),
    (f"{TRAIN} --set network.chanels=[4]", "did you mean 'channels'"),
    (f"{TRAIN} --set network.channels=[]", "must name the features of one block at least"),
    (f"{TRAIN} --set network.inverse_sigma_bounds=[2,1]", "the first must be below the second"),
    (f"{TRAIN} --set training.holdback=0.34", "leaves 1 samples to calibrate on: needs at least 100"),
    (f"{TRAIN} --start nowhere", "nowhere: is not the folder of a finished run"),
    (f"{TRAIN} --install file/model.onnx", "cannot be a folder, since .*file is a file"),
    ("train d --out new --config nowhere.yaml", "nowhere.yaml: No such file"),
    ("train d --out new --config bad.yaml", "bad.yaml:2: not valid YAML"),
    ("train d --out new --profile slow", "unknown name 'slow'"),
    ("ensemble bad.onnx bad.onnx --out file/new.onnx", "since .*file is a file"),
    ("evaluate --data d --model MODEL --out new", "holds the parts train, val"),
    ("evaluate --data d/val --model bad.onnx --out new", "bad.onnx: is not a usable ONNX model"),
    ("evaluate --data d/val --model MODEL --out file", "file: cannot be a folder"),
    ("evaluate --data d/val --model MODEL --out new --limit -1", "--limit: -1: must be a whole number"),
    ("evaluate filter --data d/val --model MODEL --out new --seed -1", "--seed: -1: must be a whole"),
    ("evaluate --data d/val --model MODEL --out new --calibrate d/train", "at least 100 held-out samples"),
    ("calibrate bad.onnx --data d/val --out new.onnx", "bad.onnx: is not a usable ONNX model"),
    ("calibrate MODEL --data d/val --out d", "d: is a folder, must be the name of a file"),
    ("calibrate MODEL --data nowhere --out new.onnx", "nowhere: is not a folder"),
    ("quantize nowhere --data d --out new.onnx", "nowhere: there is no such model file"),
    ("quantize MODEL --data cut --out new.onnx", "cut: no readable image"),
    ("quantize MODEL --data d --val nowhere --out new.onnx", "nowhere: is not a folder"),
    ("quantize MODEL --data d --out d", "d: is a folder, must be the name of a file"),
    ("quantize MODEL --data d --out new.onnx --install d", "d: is a folder"),
    ("estimate nowhere --model MODEL --out new", "is neither a data folder, nor a video file"),
    ("estimate cut --model MODEL --out new", "cut: no readable image"),
    ("estimate d/val --model bad.onnx --out new", "bad.onnx: is not a usable ONNX model"),
    ("estimate d/val --model MODEL --out file", "file: cannot be a folder"),
    ("estimate d/val --model MODEL --out new --motion-sigma -1", "--motion-sigma -1: must not be negative"),
    ("estimate d/val --model MODEL --out new --threads 0", "--threads: 0: must be a whole number from 1"),
    *((f"data check {name} --out new", message) for name, message in DATA[:6]),
    ("data check d/val --out file", "file: cannot be a folder"),
    ("data check d/val --samples 0", r"samples = 0: must lie in \[60, 100000\]"),
    ("data generate file --train 1", "file: cannot be a folder"),
    ("data generate new --train -1", "--train: -1: must be a whole number from 0"),
    ("data generate new --train 1 --seed -1", "--seed: -1: must be a whole number from 0"),
    ("data generate new --set depth=[9,1]", "depth"),
    ("data generate new --sensor nowhere.yaml", "nowhere.yaml"),
    ("data generate new --config bad.yaml", "bad.yaml:2: not valid YAML"),
    ("data collect file", "file: cannot be a folder"),
    ("data collect new --samples 0", "--samples: 0: must be a whole number from 1"),
    ("data collect new --set motion.gian=3", "did you mean 'gain'"),
    ("markers nowhere.png", "nowhere.png: there is no such file"),
    ("markers empty.png", "empty.png: is not a readable image"),
    ("markers gray.png --out new.foo", "new.foo: OpenCV writes no pictures of this kind"),
    ("markers gray.png --out file/new.png", "file is a file"),
    ("markers gray.png --out new.png --csv d", "d: is a folder"),
]  # fmt: skip


@pytest.mark.parametrize("words, message", WRONG)
def test_a_wrong_command_says_what_is_wrong_and_leaves_nothing(
    place, constant_model, monkeypatch, capsys, words, message
):
    if words.split()[0] in ("train", "ensemble", "calibrate", "quantize"):
        pytest.importorskip("torch", reason="these commands need PyTorch (the extra 'train')")
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    model = str(constant_model())
    try:
        status = tactile([model if word == "MODEL" else word for word in words.split()])
    except SystemExit as exit:  # argparse's
        status = exit.code
    said = capsys.readouterr().err
    assert status in (1, 2)
    assert re.search(message, said) and "Traceback" not in said and "Errno" not in said
    assert sorted(place.rglob("*")) == before
