"""What a calibration of a cell hands on: numbers for a file, lines for a person, values for the scene."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_base.whole_file import room_for_files

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class CalibrationError(ValueError):
    """A recording that does not tell what it is asked for; the message says what would be right."""


@dataclass(frozen=True)
class Result:
    """One calibration of the sensor of one arm.

    Attributes
    ----------
    numbers : mapping
        For the result's file, by names that end in their units.
    lines : tuple of str
        What was found, for a person.
    agrees : bool
        Whether what the scene says is within three standard deviations of what was found.
    sensor : mapping
        What the scene is to say of the sensor, by its names in the scene's file.
    draw : callable
        Makes the picture.
    """

    numbers: Mapping[str, Any]
    lines: tuple[str, ...]
    agrees: bool
    sensor: Mapping[str, Any]
    draw: Callable[[], Figure]

    def write(self, folder: Path, name: str) -> list[Path]:
        """Write NAME.json and NAME.png, earlier ones are kept; their paths."""
        import matplotlib.pyplot as plt

        from tactile_records.runs.figures import style

        room_for_files(folder / f"{name}.json", folder / f"{name}.png")
        folder.mkdir(parents=True, exist_ok=True)
        written = {"agrees": self.agrees, **self.numbers, "sensor": dict(self.sensor)}
        (folder / f"{name}.json").write_text(json.dumps(written, indent=2) + "\n")
        with style():
            figure = self.draw()
            figure.savefig(folder / f"{name}.png")
            plt.close(figure)
        return [folder / f"{name}.json", folder / f"{name}.png"]
