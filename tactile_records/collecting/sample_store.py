"""Where collected samples go: public layout, image without contact, and the surface found by touch."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json, read_text
from tactile_geometry import se3
from tactile_perception.datasets.layout import AXES, FORCE_COLUMNS, DatasetError
from tactile_perception.datasets.writer import DatasetWriter
from tactile_perception.estimating.labels import euler_from_pose
from tactile_perception.estimating.preprocessing import PreprocessingSettings
from tactile_records.collecting.settings import Capture

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SURFACE_NAME = "surface.json"
EXTRA_COLUMNS = ("stamp_ns", *(f"target_{axis}" for axis in AXES), *(f"base_sensor_{axis}" for axis in AXES))


class SampleStore:
    """One data folder that a collection writes to; see `DatasetWriter` for what it survives.

    Beside the label, each row keeps the exposure's stamp, what was asked for, and the sensor in the arm's
    base, both in mm and degrees (extrinsic xyz), and with `forces` the force on the sensor in N.
    """

    def __init__(
        self, folder: str | Path, preprocessing: PreprocessingSettings, images: str, forces: bool = False
    ) -> None:
        self.folder = Path(folder)
        extra = (*EXTRA_COLUMNS, *FORCE_COLUMNS) if forces else EXTRA_COLUMNS
        self.writer = DatasetWriter(self.folder, preprocessing, images, extra, durable=True)

    def missing(self, samples: int) -> list[int]:
        """Numbers, from 1, of the samples that are not there yet."""
        return sorted(set(range(1, samples + 1)) - self.writer.done)

    def keep_reference(self, image: Image) -> None:
        """Keep the image without contact, as number 0."""
        self.writer.add_image(0, image)

    def keep(self, capture: Capture, image: Image) -> None:
        """Keep a sample."""
        poses = np.concatenate([_mm_deg(capture.target), euler_from_pose(capture.T_base_sensor)])
        values: dict[str, float | int] = dict(zip(EXTRA_COLUMNS[1:], poses.tolist(), strict=True))
        values["stamp_ns"] = capture.stamp_ns
        if capture.force is not None:
            values |= dict(zip(FORCE_COLUMNS, capture.force.tolist(), strict=True))
        self.writer.add(capture.number, image, _mm_deg(capture.euler), values)

    def keep_surface(self, T_base_f: Array, assumed: Array, touches: int) -> None:
        """Keep where touches have found the surface, and that in words."""
        moved = se3.log(se3.inverse(assumed) @ T_base_f)
        aside = 1e3 * float(np.linalg.norm(moved[:2]))
        text = (
            f"surface found by {touches} touches: {1e3 * moved[2]:+.2f} mm deeper than assumed"
            f"{f', {aside:.2f} mm aside' if aside > 0.005 else ''}"
            f", turned by {math.degrees(float(np.linalg.norm(moved[3:]))):.2f} deg"
        )
        content = {"frame": se3.euler_from_pose(T_base_f).tolist(), "unit": "m, rad", "note": text}
        (self.folder / SURFACE_NAME).write_text(json.dumps(content, indent=2) + "\n")

    def surface(self) -> Array | None:
        """The contact frame (4, 4) that touches have found before; raises as `found_surface`."""
        found = found_surface(self.folder)
        return None if found is None else found[0]

    def finish(self) -> None:
        """Make the table whole and let others write to the folder."""
        try:
            self.writer.finish()
        finally:
            self.writer.close()


def found_surface(folder: Path) -> tuple[Array, str] | None:
    """The contact frame (4, 4) that touches have found, and that in words; None if they have not.

    Raises `DatasetError` if the file that holds it cannot be read.
    """
    path = folder / SURFACE_NAME
    if not path.exists():
        return None
    try:
        content = parse_json(read_text(path))
        frame = np.array(content["frame"], dtype=np.float64)
        if frame.shape != (6,) or not np.isfinite(frame).all():
            raise ValueError("frame must be six finite numbers")
        return se3.pose_from_euler(frame), str(content["note"])
    except (ValueError, KeyError, TypeError) as error:
        raise DatasetError(f"{path}: cannot be read ({error}); remove it to find the surface anew") from error


def _mm_deg(euler: Array) -> Array:
    return np.concatenate([1e3 * euler[:3], np.degrees(euler[3:])])
