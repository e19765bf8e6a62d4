"""Every class of settings that a file of ours declares, the goals of tasks among them."""

import importlib
from pathlib import Path

from tactile_base.settings import Settings

ROOT = Path(__file__).parents[1]


def all_settings() -> list[type[Settings]]:
    """By module and name."""
    for file in sorted(ROOT.glob("tactile_*/**/*.py")):
        if "= setting(" in file.read_text():
            importlib.import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))
    found, ahead = [], [Settings]
    while ahead:
        ahead += (below := ahead.pop().__subclasses__())
        found += [kind for kind in below if kind.__module__.startswith("tactile_")]
    return sorted(set(found), key=lambda kind: (kind.__module__, kind.__qualname__))
