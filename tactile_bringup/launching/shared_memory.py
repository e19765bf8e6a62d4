"""Removes what killed ROS nodes leave in shared memory (Fast DDS: /dev/shm/fastdds_*, sem.fastdds_*).

A Fast DDS process holds a file lock on `<segment>_el` for as long as it lives; that is also how
`fastdds shm clean` tells the dead from the living. Some port files stay without a lock file even after a
regular end, so these count as dead when no lock on them is held and no process maps them. Segments of other
users, and those made before `since_ns`, are left alone.

Nodes of other launches start meanwhile. One that finds its lock taken, if only by our look at it, goes on
without shared memory and hears nobody. So locks are read from the kernel's list, where it shows all of them.
"""

from __future__ import annotations

import fcntl
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path

from tactile_base.stamps import SECOND_NS

SHARED_MEMORY = Path("/dev/shm")
_LOCK = "_el"
_SEGMENT = re.compile(r"^(fastdds|fastrtps)_(?P<name>port\d+|[0-9a-f]{16})(_el|_sl)?$")
_MUTEX = re.compile(r"^sem\.(fastdds|fastrtps)_(?P<name>port\d+)_mutex$")
_FRESH = SECOND_NS // 5  # ns, for which a file may wait for its maker to lock it
_LOCKS = Path("/proc/locks")
_ALL_PROCESSES = "pid:[4026531836]"  # the namespace in which that list is whole


def remove_orphans(since_ns: int = 0, folder: Path = SHARED_MEMORY) -> list[str]:
    """Remove what dead processes left, made at or after `since_ns` (epoch, ns); returns the files removed."""
    return sorted(path.name for group in _dead(since_ns, folder) for path in group if _unlink(path))


def orphans(since_ns: int = 0, folder: Path = SHARED_MEMORY) -> list[Path]:
    """The files of dead processes of this user, made at or after `since_ns` (epoch, ns)."""
    return sorted(path for group in _dead(since_ns, folder) for path in group)


def _dead(since_ns: int, folder: Path) -> Iterator[list[Path]]:
    """Files that belong together, each time as they are found dead: a port may be used again."""
    groups: dict[str, list[Path]] = {}
    made: dict[str, int] = {}
    for path in folder.glob("*"):
        match, status = _SEGMENT.match(path.name) or _MUTEX.match(path.name), _status(path)
        if match and status and status.st_uid == os.getuid():
            name = match["name"]
            groups.setdefault(name, []).append(path)
            made[name] = max(made.get(name, 0), status.st_mtime_ns)
    mapped, until_ns = _mapped_files(folder), time.time_ns() - _FRESH
    for name, group in groups.items():
        if since_ns <= made[name] <= until_ns and not _is_owned(group, mapped):
            yield group


def segments(folder: Path = SHARED_MEMORY) -> set[str]:
    """Names of all Fast DDS files in shared memory."""
    return {path.name for path in folder.glob("*") if _SEGMENT.match(path.name) or _MUTEX.match(path.name)}


def _status(path: Path) -> os.stat_result | None:
    try:
        return path.lstat()
    except FileNotFoundError:  # its process removed it since the folder was listed
        return None


def _is_owned(paths: list[Path], mapped: set[str]) -> bool:
    """Whether a living process holds its lock or, if it is a port or has no lock file, maps it.

    The lock alone decides about a participant's own segment: its readers, we among them, may have it mapped
    long after its process has died.
    """
    locks = [path for path in paths if path.name.endswith(_LOCK)]
    if any(map(_is_locked, locks)):
        return True
    is_port = any("port" in path.name for path in paths)
    return (is_port or not locks) and any(str(path) in mapped for path in paths)


def _mapped_files(folder: Path) -> set[str]:
    """Files in the folder that any process which we may look into has mapped."""
    mapped: set[str] = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        try:
            lines = maps.read_text().splitlines()
        except OSError:  # the process ended, or is not ours
            continue
        mapped |= {line.split(None, 5)[5] for line in lines if str(folder) in line}
    return mapped


def _is_locked(path: Path) -> bool:
    """Whether a process holds the lock; in a container by a shared one, which two may have at once."""
    try:
        if os.readlink("/proc/self/ns/pid") == _ALL_PROCESSES:
            inode = str(path.stat().st_ino)
            return any(line.split()[-3].endswith(f":{inode}") for line in _LOCKS.read_text().splitlines())
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False
    return False


def _unlink(path: Path) -> bool:
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True
