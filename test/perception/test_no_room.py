"""Commands of perception whose results cannot be written end with a sentence, and leave no half files."""

import resource
from contextlib import contextmanager
from pathlib import Path

import pytest

from tactile_bringup.cli import main as tactile

pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")

SMALL = "--set network.image_size=16 --set network.channels=[4,4] --set training.threads=1"


@contextmanager
def no_file_longer_than(size: int):
    """What is written beyond this fails, as on a disk that is full: there is no room for the rest."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture(scope="module")
def place(tmp_path_factory, training_data) -> Path:
    """A folder with the data in it."""
    folder = tmp_path_factory.mktemp("room")
    (folder / "d").symlink_to(training_data)
    return folder


COMMANDS = {
    "train": (f"train d --out OUT --limit 16 {SMALL}", 0),
    "train, in its state": (f"train d --out OUT --limit 16 {SMALL}", 4000),
    "evaluate": ("evaluate --data d/val --model MODEL --out OUT", 0),
    "evaluate filter": ("evaluate filter --data d/val --model MODEL --out OUT", 0),
    "estimate": ("estimate d/val --model MODEL --out OUT --limit 3", 0),
    "ensemble": ("ensemble MODEL MODEL --out OUT/new.onnx", 0),
    "markers": ("markers d/val/processed_images/image_1.png --out OUT/new.png", 0),
    "data check": ("data check d/val --out OUT", 0),
    "data generate": ("data generate OUT --train 1 --val 0 --jobs 1", 0),
}


@pytest.mark.parametrize(("command", "size"), COMMANDS.values(), ids=COMMANDS)
def test_a_disk_that_is_full_ends_a_command_with_a_sentence(
    place, tmp_path, constant_model, monkeypatch, capsys, command, size
):
    monkeypatch.chdir(place)
    words = {"OUT": str(tmp_path / "out"), "MODEL": str(constant_model())}
    for name, path in words.items():
        command = command.replace(name, path)
    with no_file_longer_than(size):
        status = tactile(command.split())
    shown = capsys.readouterr().err
    assert status in (1, 2)
    assert "File too large" in shown and f"tactile {command.split()[0]}" in shown
    assert not list((tmp_path / "out").rglob("*.tmp"))


@pytest.mark.parametrize("command", [command for command, size in COMMANDS.values() if size == 0], ids=str)
def test_a_place_that_cannot_be_written_to_is_told_by_name(
    place, constant_model, monkeypatch, capsys, command
):
    monkeypatch.chdir(place)
    command = command.replace("OUT", "/sys/out").replace("MODEL", str(constant_model()))
    assert tactile(command.split()) in (1, 2)
    assert "/sys" in capsys.readouterr().err
