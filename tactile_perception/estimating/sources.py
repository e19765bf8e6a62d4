"""Sources of images for the estimator outside ROS: a data folder, a video file, a camera."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import check_regular
from tactile_base.stamps import SECOND_NS
from tactile_perception.datasets.dataset import DatasetError, TactileFolder
from tactile_perception.estimating.contact_model import ContactModel
from tactile_perception.estimating.image import Image, ImageError, gray, in_color
from tactile_perception.estimating.labels import EULER_COLUMNS, EULER_COMPONENTS, surface_contact_pose


class SourceError(ValueError):
    """A source that cannot be opened, or poses that do not fit it."""


@dataclass(frozen=True)
class Frame:
    """One image and what is known with it.

    Attributes
    ----------
    processed : the image is one of `processed_images/`
    label : Euler surface contact pose (6,) in mm and degrees, or None
    force : (3,) in N, as labelled
    labelled : what of both is
    T_base_sensor : (4, 4) pose of the sensor in SI, or None
    """

    name: str
    stamp_ns: int
    image: Image
    processed: bool
    label: NDArray[np.float64] | None = None
    T_base_sensor: NDArray[np.float64] | None = None
    force: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.nan))
    labelled: tuple[str, ...] = EULER_COMPONENTS

    def label_for(self, model: ContactModel) -> NDArray[np.float64]:
        """What a network of this contact model is to say (K,); NaN where that is not labelled."""
        assert self.label is not None
        return model.labels(self.label[None], self.force[None], self.labelled)[0]


def folder_frames(folder: TactileFolder, order: NDArray[np.int64], period_s: float = 0.1) -> Iterator[Frame]:
    """Images of a data folder in the given order, with their labels.

    A flat, fixed surface is the base here, so that a label is the sensor's pose too (the paper's filter
    experiment), where all of it is labelled. `ImageError` from an unusable image ends the iteration; `order`
    leaves those out.
    """
    whole = set(EULER_COMPONENTS) <= set(folder.labelled)
    for count, index in enumerate(order):
        euler = folder.euler_mm_deg[index]
        yield Frame(
            name=folder.names[index],
            stamp_ns=round(count * period_s * SECOND_NS),
            image=folder.image(index),
            processed=folder.processed,
            label=euler,
            T_base_sensor=surface_contact_pose(euler) if whole else None,
            force=folder.force[index],
            labelled=(*folder.labelled, *folder.forces),
        )


def video_frames(
    source: str | int, poses: list[NDArray[np.float64]] | None, limit: int | None, color: bool = False
) -> Iterator[Frame]:
    """Frames of a video file or of a camera (by index), as camera images, gray or in color.

    Raises `SourceError` if the source does not open or gives no frame, or there are fewer poses than frames.

    Parameters
    ----------
    poses : (4, 4) of the sensor in the base, one for each frame
    limit : stop after this many frames
    """
    capture = cv2.VideoCapture(source)
    try:
        if not capture.isOpened():
            raise SourceError(
                f"{source}: cannot be opened as a {'camera' if isinstance(source, int) else 'video'}"
            )
        rate = capture.get(cv2.CAP_PROP_FPS) or 30.0
        count = 0
        while limit is None or count < limit:
            ok, image = capture.read()
            if not ok:
                break
            if poses is not None and count >= len(poses):
                raise SourceError(f"{source}: has more frames than there are poses ({len(poses)})")
            picture = (in_color if color else gray)(np.asarray(image, np.uint8))
            pose = None if poses is None else poses[count]
            yield Frame(f"frame {count}", round(count / rate * SECOND_NS), picture, False, None, pose)
            count += 1
        if count == 0:
            raise SourceError(f"{source}: gave no frame")
    finally:
        capture.release()


def read_poses(path: Path) -> list[NDArray[np.float64]]:
    """Poses (4, 4) of the sensor in the base from a table.

    Its columns: x_mm, y_mm, z_mm, alpha_deg, beta_deg, gamma_deg.
    """
    poses = []
    try:
        check_regular(path)
        with path.open(newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in EULER_COLUMNS if name not in (reader.fieldnames or [])]
            if missing:
                raise SourceError(f"{path}: has no column {', '.join(missing)}")
            for row in reader:
                values = np.array([float(row[name]) for name in EULER_COLUMNS])
                if not np.all(np.isfinite(values)):
                    raise SourceError(f"{path}, line {reader.line_num}: a pose must be finite")
                poses.append(surface_contact_pose(values))
    except (OSError, TypeError, ValueError) as error:
        if isinstance(error, SourceError):
            raise
        raise SourceError(f"{path}: cannot be read as a table of poses: {error}") from error
    return poses


def usable_order(folder: TactileFolder, seed: int, limit: int | None) -> NDArray[np.int64]:
    """Indices of the samples whose image can be used, shuffled (published tables are sorted by depth).

    Images that cannot be used are added to the folder's report.
    """
    order = np.random.default_rng(seed).permutation(len(folder))
    if limit is not None:
        order = order[:limit]
    usable = []
    for index in order:
        try:
            folder.image(index)
        except ImageError as error:
            folder.report.add("unusable image", str(error))
        else:
            usable.append(index)
    folder.report.samples = len(usable)
    if not usable:
        raise DatasetError("\n".join([f"{folder.folder}: no readable image", *folder.report.lines()]))
    return np.array(usable)
