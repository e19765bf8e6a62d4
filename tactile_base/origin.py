"""What a result came of: command line, versions, machine and time, to be kept beside it."""

from __future__ import annotations

import functools
import os
import platform
import shlex
import sys
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGE = "tactile_servoing"
LIBRARIES = ("numpy", "scipy", "onnxruntime", "opencv-contrib-python-headless")


def origin() -> dict[str, str]:
    """Names and texts, as a person reads them."""
    program = "tactile" if Path(sys.argv[0]).name in ("tactile", "cli.py") else Path(sys.argv[0]).name
    return {
        "command": shlex.join([program, *sys.argv[1:]]),
        "time": datetime.now(timezone.utc).isoformat(sep=" ", timespec="seconds"),
        **_installation(),
    }


@functools.cache
def _installation() -> dict[str, str]:
    """What stays as it is while a process runs, of which an experiment makes thousands of records."""
    libraries = [f"{name} {found}" for name in LIBRARIES if (found := _version(name))]
    return {
        "version": f"{PACKAGE} {_version(PACKAGE) or 'not installed'}",
        "libraries": ", ".join([f"Python {platform.python_version()}", *libraries]),
        "machine": f"{processor()}, {platform.system()} {platform.release()}",
    }


def processor() -> str:
    """The processor's name and how many cores there are."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores"


def _version(package: str) -> str:
    """'' where it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""
