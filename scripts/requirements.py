"""Print what setup.cfg requires, one requirement a line: requirements.py [EXTRA...].

Of PyTorch that is `TORCH`, unless the environment variable TORCH says another one.
"""

import configparser
import os
import re
import sys
from pathlib import Path

TORCH = "torch==2.13.0"


def requirements(extras: list[str]) -> list[str]:
    """The requirements of the package and of the named extras."""
    config = configparser.ConfigParser()
    config.read(Path(__file__).parent.parent / "setup.cfg")
    known = config["options.extras_require"]
    for extra in extras:
        if extra not in known:
            sys.exit(f"requirements.py: no extra '{extra}' in setup.cfg; there are: {', '.join(known)}")
    blocks = [config["options"]["install_requires"], *(known[extra] for extra in extras)]
    torch = os.environ.get("TORCH") or TORCH
    return [
        torch if re.match(r"torch\b", line) else line
        for block in blocks
        for line in block.splitlines()
        if line
    ]


if __name__ == "__main__":
    print("\n".join(requirements(sys.argv[1:])))
