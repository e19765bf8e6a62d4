"""Pictures of a checked data set: how labels are spread, how markers move, what a network sees."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_perception.datasets.check import CheckResult
from tactile_perception.estimating.image import Image, gray
from tactile_perception.estimating.labels import EULER_COMPONENTS, EULER_TITLES
from tactile_perception.estimating.preprocessing import PreprocessingSettings, Preprocessor
from tactile_perception.markers.flow import regressions

_DPI = 90
_GAMMA_LARGER = 5
SHOWN = 5  # camera images


def draw_labels(result: CheckResult, path: Path) -> None:
    """Histograms of the components, and where shear and contact angles lie."""
    labels = result.folder.euler_mm_deg
    figure = Figure(figsize=(13, 6))
    axes = figure.subplots(2, 4)
    for k, axis in enumerate(axes[:, :3].ravel()):
        axis.hist(labels[:, k], bins=40, color="0.5")
        axis.set(xlabel=EULER_TITLES[k], ylabel="samples" if k % 3 == 0 else "")
    for axis, (i, j) in ((axes[0, 3], (0, 1)), (axes[1, 3], (3, 4))):
        axis.plot(labels[:, i], labels[:, j], "k.", **_dots(len(labels)))
        axis.set(xlabel=EULER_TITLES[i], ylabel=EULER_COMPONENTS[j])
        axis.set_aspect("equal", adjustable="datalim")
    figure.suptitle(f"{result.folder.folder}: {len(labels)} samples")
    _save(figure, path)


def draw_rows(result: CheckResult, path: Path) -> None:
    """Each component by row: sorted tables, drifts and stretches of one kind are seen here."""
    labels = result.folder.euler_mm_deg
    figure = Figure(figsize=(11, 8))
    axes = figure.subplots(6, 1, sharex=True)
    for k, axis in enumerate(axes):
        axis.plot(labels[:, k], "k.", ms=1)
        axis.set_ylabel(EULER_TITLES[k])
    axes[-1].set_xlabel("row")
    _save(figure, path)


def draw_flow(result: CheckResult, path: Path) -> None:
    """How the markers move by each label, with what their directions say."""
    flow = result.flow
    if flow is None:
        return
    figure = Figure(figsize=(15, 4.2))
    axes = figure.subplots(1, 4)
    rank = np.argsort(np.argsort(flow.labels[:, 2])) / len(flow.labels)
    deep = rank > 0.5
    _, _, _, alpha, beta, gamma = flow.labels.T
    middle = np.ones(len(flow.labels))
    basis = np.stack([middle, rank - 0.75, *flow.labels[:, :2].T, -beta, alpha, gamma], axis=1)
    fields = regressions(basis, flow.positions, deep, 4 * basis.shape[1] + 1)
    size = np.abs(basis[deep]).max(axis=0)
    shown = (
        ("shear: x and y parallel,\nat a right angle to each other", (("x", 2, "C0"), ("y", 3, "C1"))),
        ("tilt: -beta as x, alpha as y", (("-beta", 4, "C2"), ("alpha", 5, "C3"))),
        ("twist: round the middle", (("gamma", 6, "C4"),)),
    )
    for axis, (right, group) in zip(axes, shown, strict=False):
        axis.set_title(right, fontsize=10)
        for name, k, color in group:
            larger = _GAMMA_LARGER if name == "gamma" else 1
            label = name if larger == 1 else f"{name}, {larger} times as long"
            _arrows(axis, flow.rest, larger * fields[:, k] * size[k] / 2, color, label)
        axis.legend(loc="upper right", fontsize=8)
    _arrows(axes[3], flow.rest, fields[:, 0] - flow.rest, "k", "pressing")
    axes[3].set_title("pressing: away from the middle", fontsize=10)
    axes[3].legend(loc="upper right", fontsize=8)
    figure.suptitle(
        "motion of the markers in the image by half of the range of each label; above each what is right"
    )
    _save(figure, path)


def draw_inputs(
    images: Sequence[Image], settings: PreprocessingSettings, path: Path, reference: Image | None = None
) -> None:
    """Camera images with their crop, and below each what a network sees of it; `reference` is one of them."""
    preprocessor = Preprocessor(settings)
    if settings.difference and reference is not None:
        preprocessor.reference = preprocessor.processed(reference)
    shown = images[:SHOWN]
    figure = Figure(figsize=(2.6 * len(shown), 5.0))
    axes = figure.subplots(2, len(shown), squeeze=False)
    x0, y0, x1, y1 = settings.bbox
    for (above, below), image in zip(axes.T, shown, strict=True):
        picture = image if settings.color else gray(image)
        above.imshow(_shown(picture), cmap="gray", vmin=0, vmax=255)
        above.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color="C1", lw=1)
        below.imshow(
            _shown(preprocessor.resized(preprocessor.processed(picture))), cmap="gray", vmin=0, vmax=255
        )
        for axis in (above, below):
            axis.set_axis_off()
    figure.suptitle(f"Camera images, and what a network sees of them:\n{settings.steps}", fontsize=9)
    _save(figure, path)


def _shown(image: Image) -> NDArray[np.uint8]:
    """As matplotlib takes it: gray, or red, green and blue."""
    return image if image.ndim == 2 else image[:, :, ::-1]


def _dots(count: int) -> dict[str, float]:
    """How so many dots are drawn that few are seen, and many do not run into one."""
    root = max(count, 1) ** 0.5
    return {"ms": min(8.0, max(3.0, 150.0 / root)), "mew": 0.0, "alpha": min(0.8, max(0.15, 40.0 / root))}


def _arrows(axis: Any, rest: np.ndarray, motion: np.ndarray, color: str, name: str) -> None:
    axis.quiver(
        *rest.T, *motion.T, color=color, angles="xy", scale_units="xy", scale=1.0, width=0.004, label=name
    )
    axis.set_aspect("equal")
    axis.invert_yaxis() if not axis.yaxis_inverted() else None
    axis.set_xticks([])
    axis.set_yticks([])


def _save(figure: Figure, path: Path) -> None:
    figure.tight_layout()
    figure.savefig(path, dpi=_DPI)
