"""Results in files: whole or not at all, as tables, in folders that can be written to, none lost."""

from __future__ import annotations

import csv
import fcntl
import itertools
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

LOCK_NAME = ".writing"


@contextmanager
def whole_file(path: Path | str) -> Iterator[Path]:
    """A file beside `path` to write to, which takes its name when all went well and else disappears::

    with whole_file("run/model.onnx") as temporary:
        onnx.save_model(model, temporary)
    """
    path = Path(path)
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        error.filename = error.filename or str(path)  # a disk that is full does not say where
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Iterable[Any]]) -> None:
    """Write a table with lines that end as on Unix, whole or not at all."""
    with whole_file(path) as temporary, temporary.open("w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([header, *rows])


def check_folder(path: Path) -> None:
    """`OSError` unless `path` is a folder that can be written to, or can become one; makes nothing.

    For what takes long before it writes.
    """
    existing = next(part for part in (path.absolute(), *path.absolute().parents) if part.exists())
    if not existing.is_dir():
        raise NotADirectoryError(f"{path}: cannot be a folder, since {existing} is a file")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise PermissionError(f"{path}: no permission to write in {existing}")


def only_writer(folder: Path) -> IO[str]:
    """A lock on a folder, which is there, until it is closed or this process ends, whatever ends it.

    Raises `BlockingIOError` where another process has it.
    """
    file = (folder / LOCK_NAME).open("w")
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise BlockingIOError(f"{folder}: another process is writing to this folder") from error
    return file


def room_for_results(folder: Path, *results: str, source: Path | None = None) -> None:
    """Have a folder be there to write results to; earlier ones are kept beside it.

    Where a file or folder in it matches one of the patterns `results`, the whole folder becomes FOLDER-1,
    FOLDER-2 and so on, which is said; not where the `source` of the new ones is in it, of which the earlier
    ones are, too. `OSError` as of `check_folder`, and for the current folder.
    """
    check_folder(folder)
    if source is not None and source.resolve().is_relative_to(folder.resolve()):
        return
    if not any(any(folder.glob(pattern)) for pattern in results):
        return
    if Path.cwd().is_relative_to(folder.resolve()):
        raise FileExistsError(f"{folder}: holds earlier results; name a folder for new ones")
    numbered = (folder.with_name(f"{folder.name}-{number}") for number in itertools.count(1))
    aside = next(path for path in numbered if not path.exists())
    folder.rename(aside)
    print(f"earlier results of {folder} are in {aside} now", file=sys.stderr)


def room_for_files(*paths: Path) -> None:
    """Have there be no files of these names, which belong together; earlier ones are kept beside them.

    All of those that are there become NAME-1, NAME-2 and so on, with one number, which is said. `OSError` as
    of `check_file`.
    """
    for path in paths:
        check_file(path)
    for number in itertools.count(1):
        aside = {path: path.with_name(f"{path.stem}-{number}{path.suffix}") for path in paths}
        if not any(kept.exists() for kept in aside.values()):
            break
    for path, kept in aside.items():
        if path.exists():
            path.rename(kept)
            print(f"the earlier {path} is {kept} now", file=sys.stderr)


def check_file(path: Path) -> None:
    """`OSError` unless a file can be written at `path`, in a folder that is there or can be made."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: is a folder, must be the name of a file")
    check_folder(path.absolute().parent)


def copy_whole(source: Path, path: Path) -> None:
    """Copy a file, whole or not at all; the folder is made if it is not there."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        shutil.copyfile(source, temporary)
