"""Print what setup.cfg requires, one requirement a line: requirements.py [EXTRA...].

The environment variable TORCH, if set, stands in for the requirement of PyTorch.
"""

import configparser
import os
import re
import sys
from pathlib import Path


def requirements(extras: list[str]) -> list[str]:
    """The requirements of the package and of the named extras."""
    config = configparser.ConfigParser()
    config.read(Path(__file__).parent.parent / "setup.cfg")
    known = config["options.extras_require"]
    for extra in extras:
        if extra not in known:
            sys.exit(f"requirements.py: no extra '{extra}' in setup.cfg; there are: {', '.join(known)}")
    blocks = [config["options"]["install_requires"], *(known[extra] for extra in extras)]
    torch = os.environ.get("TORCH")
    return [
        torch if torch and re.match(r"torch\b", line) else line
        for block in blocks
        for line in block.splitlines()
        if line
    ]


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1:])))
