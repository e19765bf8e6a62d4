"""Checks a data folder: what is in it, how its labels are spread, and which conventions its images tell.

    result = check(open_folder("data/train"))
    for finding in result.findings:
        print(finding.level, finding.topic, finding.text)

A finding is "ok", "note" (worth knowing), "warning" (costs accuracy) or "error" (labels or images are wrong).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from tactile_perception.datasets import visibility
from tactile_perception.datasets.conventions import (
    Conventions,
    Explanation,
    depth_alone,
    find_conventions,
    sense_of_turning,
)
from tactile_perception.datasets.dataset import TactileFolder
from tactile_perception.datasets.layout import DatasetReport
from tactile_perception.datasets.statistics import LabelStatistics, label_statistics
from tactile_perception.datasets.table import CONVENTIONS_NAME, ConventionSettings, read_conventions
from tactile_perception.datasets.visibility import Visibility
from tactile_perception.estimating.image import Image, ImageError, decoded
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.markers.flow import (
    FlowError,
    FlowSettings,
    MarkerFlow,
    follow,
    look,
    variety_with_depth,
)

Array = NDArray[np.float64]

LEVELS = ("ok", "note", "warning", "error")
_USUAL_DEPTH_MM, _USUAL_ANGLE_DEG = 20.0, 90.0
#: What has to be labelled for images to tell directions: they come from what shear and tilt have in common.
_DIRECTED = ("x", "y", "z", "alpha", "beta")
_CERTAIN = 5.0  # standard errors
_WIDEST_GAMMA_DEG = 90.0  # range up to which x and y are directions in the sensor, too


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
    visibility: Visibility | None = None

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
    settings = settings or FlowSettings()
    try:
        chosen, images = look(folder, settings, None if progress is None else partial(progress, "markers"))
    except FlowError as error:
        result.add("warning", "conventions", f"images do not tell the conventions: {error}")
        return result
    _report_depth(result, variety_with_depth(images, folder.euler_mm_deg[chosen]))
    try:
        result.flow = follow(folder, chosen, images, settings)
    except FlowError as error:
        result.add("warning", "conventions", f"images do not tell directions and units: {error}")
    else:
        _report_conventions(result)
    _report_correction(result)
    if len(chosen) >= visibility.FEWEST:
        _report_visibility(result, chosen, images)
        _report_sums(result, chosen)
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
        try:
            data = folder.stored(count)
            digest = hashlib.blake2b(data, digest_size=16).digest()
            if digest in seen:
                twice.append(f"{name} = {seen[digest]}")
            else:
                seen[digest] = name
                image = decoded(data, str(folder.path(count)))
                if image.min() == image.max():
                    blank.append(name)
        except ImageError as error:
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
    labelled = result.folder.labelled
    if missing := [name for name in EULER_COMPONENTS if name not in labelled]:
        result.add(
            "warning",
            "labels",
            f"{', '.join(missing)} not labelled: a network trained on this knows their bounds alone",
        )
    if constant := [name for name in found.constant if name in labelled]:
        result.add("warning", "labels", f"{', '.join(constant)} never changes: nothing to learn from it")
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
    on_edge = _goes_round(result.folder.euler_mm_deg)
    largest = np.abs(ranges[3 : 5 if on_edge else 6, :2]).max()
    if largest > _USUAL_ANGLE_DEG:
        result.add("warning", "labels", f"an angle of {largest:.1f} deg is unusual")
    if not found.spreads:
        result.add(
            "note", "coverage", f"{len(result.folder)} samples are too few to tell how they are spread"
        )
    disk = not on_edge and {"x", "y"} <= set(labelled)  # on an edge y is the offset
    for spread in found.spreads:
        if spread.name.startswith("x, y") and not disk:
            continue
        text = f"{spread.name}: {spread.emptiest} to {spread.fullest} samples in each tenth"
        if spread.even:
            result.add("ok", "coverage", f"{text}, even (distance {spread.distance:.3f})")
        else:
            result.add("warning", "coverage", f"{text}, uneven (distance {spread.distance:.3f})")
    tilted = {"alpha", "beta"} <= set(labelled)
    filled_by = (("x, y", found.shear_sectors, disk), ("alpha, beta", found.tilt_sectors, tilted))
    for name, sectors, filled in filled_by:
        empty = int((sectors == 0).sum())
        if filled and empty and sectors.sum() >= 10 * sectors.size:
            result.add("warning", "coverage", f"{name}: {empty} of {sectors.size} sectors are empty")
    if found.off_center:
        result.add("warning", "balance", f"the mean of {', '.join(found.off_center)} is far from zero")
    for a, b, r in found.correlated:
        result.add("warning", "balance", f"{a} and {b} are correlated ({r:+.2f})")
    if not found.off_center and not found.correlated:
        result.add("ok", "balance", "signs are balanced and no two components are correlated")


def _report_visibility(result: CheckResult, chosen: NDArray[np.int64], images: list[Image]) -> None:
    """How much of each component shows in the images, and which hardly do."""
    flow, labelled = result.flow, result.folder.labelled
    labels = result.folder.euler_mm_deg[chosen]
    found = result.visibility = (
        visibility.of_images(labels, images, labelled)
        if flow is None
        else visibility.of_markers(labels, flow.positions, labelled)
    )
    shares = ", ".join(f"{name} {share:.1%}" for name, share in found.shares.items())
    result.add(
        "ok", "shows", f"of the {found.of} each component explains: {shares}; noise is {found.noise:.1%}"
    )
    for name in found.hardly:
        advice = "expect little of its estimates"
        text = f"{name} hardly shows: it explains {found.shares[name]:.1%} of the {found.of}"
        if name == "gamma" and flow is not None and result.conventions:
            full = 1.0 if result.conventions.angle_unit == "rad" else np.radians(1.0)
            text += f", markers turn by {abs(flow.turn.value) / full:.2f} of it"
            advice += " but by gdn_registered.yaml, for rings of 331 markers"
        result.add("note" if flow is None else "warning", "shows", f"{text}: {advice}")


def _report_sums(result: CheckResult, chosen: NDArray[np.int64]) -> None:
    """Whether the sum of pose and shear is what images show, where both vary."""
    if result.flow is None:
        return
    folder = result.folder
    found = visibility.better_parts(
        folder.pose[chosen], folder.shear[chosen], result.flow.positions, result.folder.labelled
    )
    for name, part in found.items():
        result.add(
            "error", "sums", f"{name}: pose and shear do not add up, markers follow the {part} alone more "
            "closely: import the folder by a mapping file that takes one of the two columns",
        )  # fmt: skip


def _report_depth(result: CheckResult, deeper: float) -> None:
    """Whether images change more the larger z is; they tell that without markers, too."""
    if "z" not in result.folder.labelled:
        return
    found = result.conventions = depth_alone(deeper)
    ratio = f"images at the largest z differ {deeper:.1f} times as much as at the least"
    if found.depth_flipped is None:
        result.add("warning", "conventions", f"images do not tell the direction of z ({ratio})")
    elif found.depth_flipped:
        result.add("error", "signs", f"z falls as contacts get deeper, must grow ({ratio})")
    else:
        result.add("ok", "signs", f"z grows with depth ({ratio})")


def _report_conventions(result: CheckResult) -> None:
    assert result.flow is not None
    missing = [name for name in _DIRECTED if name not in result.folder.labelled]
    on_edge = _goes_round(result.flow.labels)
    if on_edge:
        _report_turning(result)
    if missing or on_edge:
        why = f"{', '.join(missing)} not labelled" if missing else "gamma goes round too far"
        text = f"images cannot tell other signs, units and the order of angles: {why}"
        result.add("note", "conventions", text)
        return
    found = result.conventions = find_conventions(result.flow)
    more = "" if len(result.flow.labels) == len(result.folder) else ": follow markers in more (--samples)"
    for text in found.uncertain:
        if not text.endswith(" z"):
            result.add("warning", "conventions", f"{len(result.flow.labels)} images do not tell {text}{more}")
    _report_signs(result, found)
    _report_units(result, found)
    turned = {"extrinsic": "fixed axes (extrinsic xyz)", "intrinsic": "the sensor's own axes (intrinsic xyz)"}
    if found.order == "extrinsic":
        result.add("ok", "angles", f"they turn about {turned[found.order]} (t = {found.order_t:+.1f})")
    elif found.order:
        flips = [content["flip"] for content, _ in found.corrections(ConventionSettings())]
        signs = " or ".join(f"`flip: [{', '.join(names)}]`" for names in flips if names)
        also = f" and, for the signs, {signs}" if signs else ""
        result.add(
            "error", "angles",
            f"they turn about {turned[found.order]} (t = {found.order_t:+.1f}): import the folder by a "
            f"mapping file that says `euler: intrinsic xyz`{also}",
        )  # fmt: skip
    else:
        text = f"too few samples tell extrinsic from intrinsic order (t = {found.order_t:+.1f}, 3 needed)"
        result.add("note", "angles", text)


def _goes_round(labels: Array) -> bool:
    """Whether labels (n, 6) are those of contacts on an edge: gamma is its direction."""
    return bool(np.ptp(labels[:, 5]) > _WIDEST_GAMMA_DEG)


def _report_turning(result: CheckResult) -> None:
    """The sign of a gamma that goes all round, as at an edge."""
    assert result.flow is not None
    t = sense_of_turning(result.flow)
    if t < -_CERTAIN:
        result.add("ok", "signs", f"what is seen turns against gamma, as it must (t = {t:+.1f})")
    elif t > _CERTAIN:
        text = f"gamma has the opposite sign, or the images are mirrored (t = {t:+.1f})"
        result.add("error", "signs", text)
        if result.conventions:
            way = Explanation(("gamma",))
            result.conventions = replace(result.conventions, explanations=[way], cameras_deg=[np.nan])
    else:
        result.add("warning", "conventions", f"images do not tell the direction of gamma (t = {t:+.1f})")


def _report_signs(result: CheckResult, found: Conventions) -> None:
    if any(text.startswith("the direction of x") or "alpha" in text for text in found.uncertain):
        return
    if not found.explanations:
        result.add(
            "error", "signs", "x, y, alpha, beta and the images do not fit together by any choice of signs"
        )
    elif found.explanations[0].cost == 0:
        gamma = "" if any("gamma" in text for text in found.uncertain) else " and gamma"
        result.add(
            "ok", "signs",
            f"x, y, alpha, beta{gamma} move the markers as the paper's contact pose does; the sensor's "
            f"x-axis is at {round(found.camera_deg)} deg in the image",
        )  # fmt: skip
    else:
        result.add("error", "signs", "; or ".join(map(str, found.explanations)))


def _report_correction(result: CheckResult) -> None:
    """What to write into conventions.json, or between which lines the images leave the choice."""
    found = result.conventions
    if found is None:
        return
    path = result.folder.folder / CONVENTIONS_NAME
    applied = read_conventions(result.folder.folder, DatasetReport(result.folder.folder))
    lines = [(json.dumps(content), camera) for content, camera in found.corrections(applied)]
    if not lines and found.explanations:
        result.add(
            "note", "correction", f"no {CONVENTIONS_NAME} swaps axes or mirrors images: import the folder "
            "anew (`tactile data import --mapping`), or mirror its images",
        )  # fmt: skip
    if not lines or not found.wrong:
        return
    if len(lines) == 1:
        text = f"write into {path} (--write-conventions does): {lines[0][0]}"
    else:
        ways = "; or, ".join(
            f"if the sensor's x-axis is at {round(camera)} deg in the image, {line}" for line, camera in lines
        )
        text = f"images leave a choice, how the camera is mounted tells. Write into {path}, {ways}"
    if any("gamma" in name for name in found.uncertain):
        text += "; whether gamma is flipped too is open"
    result.add("note", "correction", text)


def _report_units(result: CheckResult, found: Conventions) -> None:
    for name, unit, right in (("lengths", found.length_unit, "mm"), ("angles", found.angle_unit, "deg")):
        if unit == right:
            result.add("ok", "units", f"{name} are in {right}")
        elif unit:
            result.add("error", "units", f"{name} are in {unit}, must be {right}")
