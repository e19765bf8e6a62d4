"""Checks a data folder: what is in it, how its labels are spread, and which conventions its images tell.

    result = check(open_folder("data/train"))
    for finding in result.findings:
        print(finding.level, finding.topic, finding.text)

A finding is "ok", "note" (worth knowing), "warning" (costs accuracy) or "error" (labels or images are wrong).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from tactile_perception.datasets.conventions import Conventions, find_conventions
from tactile_perception.datasets.dataset import TactileFolder
from tactile_perception.datasets.statistics import LabelStatistics, label_statistics
from tactile_perception.estimating.image import ImageError, read_image
from tactile_perception.markers.flow import FlowError, FlowSettings, MarkerFlow, measure

LEVELS = ("ok", "note", "warning", "error")
_USUAL_DEPTH_MM, _USUAL_ANGLE_DEG = 20.0, 90.0


@dataclass(frozen=True)
class Finding:
    """One thing found, in a sentence."""

    level: str
    topic: str
    text: str


@dataclass
class CheckResult:
    """All that a check has found."""

    folder: TactileFolder
    statistics: LabelStatistics
    findings: list[Finding] = field(default_factory=list)
    flow: MarkerFlow | None = None
    conventions: Conventions | None = None

    def add(self, level: str, topic: str, text: str) -> None:
        self.findings.append(Finding(level, topic, text))

    @property
    def worst(self) -> str:
        """The gravest level found."""
        return max((finding.level for finding in self.findings), key=LEVELS.index, default="ok")


def check(
    folder: TactileFolder,
    settings: FlowSettings | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> CheckResult:
    """Check a folder; `progress` is called with (what, done, total)."""
    result = CheckResult(folder, label_statistics(folder.euler_mm_deg))
    _report_reading(result)
    _report_images(result, progress)
    _report_labels(result)
    _report_conventions(result, settings or FlowSettings(), progress)
    return result


def _report_reading(result: CheckResult) -> None:
    report = result.folder.report
    for note in report.notes:
        result.add("note", "reading", note)
    for problem, names in report.problems.items():
        shown = ", ".join(names[:3]) + (f", and {len(names) - 3} more" if len(names) > 3 else "")
        result.add("warning", "reading", f"{problem}: {len(names)} ({shown})")
    if not report.problems:
        result.add("ok", "reading", f"{report.rows} rows, each with its image and no image without its row")


def _report_images(result: CheckResult, progress: Callable[[str, int, int], None] | None) -> None:
    """Every file is read whole; equal contents are reported."""
    folder = result.folder
    seen: dict[bytes, str] = {}
    twice, broken, blank = [], [], []
    for count, name in enumerate(folder.names):
        path = folder.image_folder / name
        try:
            data = path.read_bytes()
            digest = hashlib.blake2b(data, digest_size=16).digest()
            if digest in seen:
                twice.append(f"{name} = {seen[digest]}")
            else:
                seen[digest] = name
                image = read_image(path)
                if image.min() == image.max():
                    blank.append(name)
        except (ImageError, OSError) as error:
            broken.append(str(error))
        if progress is not None:
            progress("images", count + 1, len(folder.names))
    for level, what, names in (
        ("error", "images that cannot be read", broken),
        ("error", "images of one gray level", blank),
        ("warning", "images with the same content", twice),
    ):
        if names:
            result.add(level, "images", f"{len(names)} {what} ({', '.join(names[:3])})")
    if not broken and not blank and not twice:
        result.add("ok", "images", f"{len(folder.names)} images are whole, and no two are the same")


def _report_labels(result: CheckResult) -> None:
    found = result.statistics
    ranges = found.ranges
    if found.constant:
        result.add(
            "warning", "labels", f"{', '.join(found.constant)} never changes: nothing to learn from it"
        )
    if found.repeated:
        result.add("warning", "labels", f"{found.repeated} labels occur more than once")
    if found.outliers:
        names = ", ".join(result.folder.names[i] for i in found.outliers[:3])
        result.add("warning", "labels", f"{len(found.outliers)} labels lie far outside the others ({names})")
    if found.sorted_by:
        result.add(
            "note", "order", f"rows are sorted by {found.sorted_by}: shuffle before taking consecutive ones"
        )
    if np.abs(ranges[:3, :2]).max() > _USUAL_DEPTH_MM:
        result.add("warning", "labels", f"a length of {np.abs(ranges[:3, :2]).max():.1f} mm is unusual")
    if np.abs(ranges[3:, :2]).max() > _USUAL_ANGLE_DEG:
        result.add("warning", "labels", f"an angle of {np.abs(ranges[3:, :2]).max():.1f} deg is unusual")
    if not found.spreads:
        result.add(
            "note", "coverage", f"{len(result.folder)} samples are too few to tell how they are spread"
        )
    for spread in found.spreads:
        text = f"{spread.name}: {spread.emptiest} to {spread.fullest} samples in each tenth"
        if spread.even:
            result.add("ok", "coverage", f"{text}, even (distance {spread.distance:.3f})")
        else:
            result.add("warning", "coverage", f"{text}, uneven (distance {spread.distance:.3f})")
    for name, sectors in (("x, y", found.shear_sectors), ("alpha, beta", found.tilt_sectors)):
        empty = int((sectors == 0).sum())
        if empty and sectors.sum() >= 10 * sectors.size:
            result.add("warning", "coverage", f"{name}: {empty} of {sectors.size} sectors are empty")
    if found.off_center:
        result.add("warning", "balance", f"the mean of {', '.join(found.off_center)} is far from zero")
    for a, b, r in found.correlated:
        result.add("warning", "balance", f"{a} and {b} are correlated ({r:+.2f})")
    if not found.off_center and not found.correlated:
        result.add("ok", "balance", "signs are balanced and no two components are correlated")


def _report_conventions(
    result: CheckResult, settings: FlowSettings, progress: Callable[[str, int, int], None] | None
) -> None:
    step = None if progress is None else partial(progress, "markers")
    try:
        result.flow = measure(result.folder, settings, step)
    except FlowError as error:
        result.add("warning", "conventions", f"images do not tell the conventions: {error}")
        return
    found = result.conventions = find_conventions(result.flow)
    _report_signs(result, found)
    _report_units(result, found)
    for text in found.uncertain:
        result.add("warning", "conventions", f"images do not tell {text}")
    turned = {"extrinsic": "fixed axes (extrinsic xyz)", "intrinsic": "the sensor's own axes (intrinsic xyz)"}
    if found.order:
        level = "ok" if found.order == "extrinsic" else "error"
        result.add(level, "angles", f"they turn about {turned[found.order]} (t = {found.order_t:+.1f})")
    else:
        text = f"too few samples tell extrinsic from intrinsic order (t = {found.order_t:+.1f}, 3 needed)"
        result.add("note", "angles", text)


def _report_signs(result: CheckResult, found: Conventions) -> None:
    assert result.flow is not None
    if found.depth_flipped is not None:
        ratio = f"images at the largest z differ {result.flow.deeper:.1f} times as much as at the least"
        if found.depth_flipped:
            result.add("error", "signs", f"z falls as contacts get deeper, must grow ({ratio})")
        else:
            result.add("ok", "signs", f"z grows with depth ({ratio})")
    if any(text.startswith("the direction of x") or "alpha" in text for text in found.uncertain):
        return
    if not found.explanations:
        result.add(
            "error", "signs", "x, y, alpha, beta and the images do not fit together by any choice of signs"
        )
    elif found.explanations[0].cost == 0:
        result.add(
            "ok", "signs",
            "x, y, alpha, beta and gamma move the markers as the paper's contact pose does; the sensor's "
            f"x-axis is at {found.camera_deg:.0f} deg in the image",
        )  # fmt: skip
    else:
        result.add("error", "signs", "; or ".join(map(str, found.explanations)))


def _report_units(result: CheckResult, found: Conventions) -> None:
    for name, unit, right in (("lengths", found.length_unit, "mm"), ("angles", found.angle_unit, "deg")):
        if unit == right:
            result.add("ok", "units", f"{name} are in {right}")
        elif unit:
            result.add("error", "units", f"{name} are in {unit}, must be {right} (see conventions.json)")
