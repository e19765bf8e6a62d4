"""The version of the package: from the install, else from setup.cfg of the source tree."""

from __future__ import annotations

import configparser
from importlib import metadata
from pathlib import Path

DISTRIBUTION = "tactile_servoing"


def version() -> str:
    """The version, as `0.1.0`."""
    setup = Path(__file__).resolve().parents[1] / "setup.cfg"
    if setup.is_file():
        parser = configparser.ConfigParser()
        parser.read(setup)
        return parser["metadata"]["version"]
    return metadata.version(DISTRIBUTION)
