"""A picture of ten samples of a data set with their labels drawn on the images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_perception.datasets.dataset import TactileFolder
from tactile_perception.datasets.layout import FORCE_COLUMNS
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.labels import EULER_COMPONENTS

Array = NDArray[np.float64]

SHOWN = 10
_REACH = 0.42  # of an image's smaller side, the longest that an arrow gets
_CONTACT, _SHEAR, _DEPTH = "#ff8c00", "#2f9bff", "#38b66e"
_PER_ROW = 5


def draw_samples(folder: TactileFolder, path: Path, camera_deg: float | None) -> None:
    """Draw ten samples, evenly spread over the depth.

    Parameters
    ----------
    camera_deg : angle of the sensor's x-axis in the image, from columns to rows; None: not known, drawn as 0
    """
    labels = folder.euler_mm_deg
    order = np.argsort(labels[:, 2], kind="stable")
    chosen = order[np.linspace(0, len(order) - 1, min(SHOWN, len(order))).round().astype(int)]
    tilts, slides = contact_direction(labels), shear_direction(labels)
    figure = Figure(figsize=(15, 8.2))
    axes = figure.subplots(2, _PER_ROW).ravel()
    for axis in axes:
        axis.set_axis_off()
    turn = np.radians(camera_deg or 0.0)
    C = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    for axis, index in zip(axes, chosen.tolist(), strict=False):
        try:
            image = folder.image(index)
        except ImageError as error:
            axis.set_title(f"{folder.names[index]} cannot be shown:\n{error}"[:60], fontsize=8)
            continue
        axis.imshow(image, cmap="gray", vmin=0, vmax=max(1, np.percentile(image, 99.5)))
        axis.set_title(_numbers(folder, index), fontsize=8, loc="left", family="monospace")
        axis.autoscale(False)
        center = (np.array(image.shape[::-1]) - 1) / 2
        reach = _REACH * min(image.shape)
        if {"x", "y"} & set(folder.labelled):
            _arrow(axis, center, reach * C @ slides[index] / _longest(slides), _SHEAR)
        if {"alpha", "beta"} & set(folder.labelled):
            middle = center + reach * C @ tilts[index] / _longest(tilts)
            axis.plot(*middle, "o", ms=11, mew=2.5, mfc="none", mec=_CONTACT)
        if "z" in folder.labelled:
            height = np.clip(labels[index, 2] / max(float(labels[:, 2].max()), 1e-9), 0.0, 1.0)
            axis.plot([0, 0], [0, height], color=_DEPTH, lw=7, transform=axis.transAxes)
    known = "the sensor's x-axis drawn to the right: images did not tell where it is"
    if camera_deg is not None:
        known = f"the sensor's x-axis at {round(camera_deg)} deg, as the markers' shear tells"
    missing = ", ".join(name for name in EULER_COMPONENTS if name not in folder.labelled)
    figure.suptitle(
        f"{folder.folder}{f' (not labelled: {missing})' if missing else ''}\n"
        "orange ring: where the contact lies, (-beta, alpha); blue arrow: shear (x, y), which the skin lags "
        f"behind; green bar: depth z\n{known}",
        fontsize=10,
    )
    figure.tight_layout(rect=(0, 0, 1, 0.97), h_pad=1.5)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def contact_direction(labels: Array) -> Array:
    """Where contacts lie (n, 2) in the sensor, by angles of labels (n, 6): towards (-beta, alpha), deg."""
    return np.stack([-labels[:, 4], labels[:, 3]], axis=1)


def shear_direction(labels: Array) -> Array:
    """Shear x, y (n, 2) of labels (n, 6) in the sensor, which gamma has turned in the surface; mm."""
    gamma = np.radians(labels[:, 5])
    x, y = labels[:, 0], labels[:, 1]
    return np.stack([np.cos(gamma) * x + np.sin(gamma) * y, np.cos(gamma) * y - np.sin(gamma) * x], axis=1)


def _longest(vectors: Array) -> float:
    return max(float(np.linalg.norm(vectors, axis=1).max()), 1e-9)


def _arrow(axis: Any, center: Array, vector: Array, color: str) -> None:
    axis.annotate(
        "", xy=center + vector, xytext=center,
        arrowprops={"arrowstyle": "-|>", "color": color, "lw": 2.5, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip


def _numbers(folder: TactileFolder, index: int) -> str:
    """What is labelled of a sample, in three lines."""
    values = dict(zip(EULER_COMPONENTS, folder.euler_mm_deg[index], strict=True))
    force = dict(zip(FORCE_COLUMNS, folder.force[index], strict=True))
    lines = [folder.names[index]]
    groups = ((EULER_COMPONENTS[:3], values), (EULER_COMPONENTS[3:], values), (FORCE_COLUMNS, force))
    for (names, found), unit in zip(groups, ("mm", "deg", "N"), strict=True):
        shown = [f"{name} {found[name]:.1f}" for name in names if name in (*folder.labelled, *folder.forces)]
        if shown:
            lines.append(f"{'  '.join(shown)} {unit}")
    return "\n".join(lines)
