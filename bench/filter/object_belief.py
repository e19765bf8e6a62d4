"""Several contacts on one object: how certain its belief is, and how honest that is.

    python bench/filter/object_belief.py [--runs N]

A box, 60 mm wide, is held still from two or three sides; contacts err by 0.3 mm along and 0.1 mm across the
surface, 6 mrad in tilt and 15 mrad in twist. Each row is N runs (100) of some steps: the deviation of the
box's middle and of its rotation as claimed, relative to that of one contact at a place that is known exactly,
and NEES / 6, which is 1 for a belief that is as certain as it claims, and less for one that is more certain.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import Array, Table, parser

from tactile_filter.consistency import nees
from tactile_filter.object.belief import SplitGaussian
from tactile_filter.object.settings import TrackerSettings
from tactile_filter.object.tracker import ContactUpdate, ObjectTracker
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian, ros_from_left

Steps = Iterator[Mapping[str, ContactUpdate | None]]

STEP_NS = 16_666_667
SIGMA = np.array([3e-4, 3e-4, 1e-4, 6e-3, 6e-3, 1.5e-2])  # m, rad
OBJECT = se3.exp([0.5, 0.1, 0.2, 0.1, -0.3, 1.0])
FEATURES = {
    "left": se3.pose_from_euler([0.0, 0.03, 0.0, np.pi / 2, 0.0, 0.0]),
    "right": se3.pose_from_euler([0.0, -0.03, 0.0, -np.pi / 2, 0.0, 0.0]),
    "top": se3.pose_from_euler([0.0, 0.0, 0.03, np.pi, 0.0, 0.0]),
}
GIVEN = {name: PoseGaussian(T, np.zeros((6, 6))) for name, T in FEATURES.items()}
PAIR, THREE = ("left", "right"), ("left", "right", "top")


def update(name: str, error: Array) -> ContactUpdate:
    """What a sensor with this error (6,) believes of its contact."""
    X_sf = se3.exp([0.0, 0.0, -3e-3, 0.0, 0.0, 0.0])
    sensor = OBJECT @ FEATURES[name] @ se3.inverse(X_sf)
    return ContactUpdate(PoseGaussian(se3.exp(error) @ X_sf, np.diag(SIGMA**2)), sensor)


def together(names: tuple[str, ...], count: int, random: np.random.Generator) -> Steps:
    """All touch from the first step on, each with one error for all steps."""
    errors = {name: SIGMA * random.normal(size=6) for name in names}
    for _ in range(count):
        yield {name: update(name, error) for name, error in errors.items()}


def handed_over(random: np.random.Generator) -> Steps:
    """The first contact ends after the second has been placed."""
    *before, last = together(PAIR, 3, random)
    yield from before
    yield {**last, "left": None}


def regrasped(random: np.random.Generator) -> Steps:
    """The first contact ends and begins anew, then the second does; then both hold."""
    errors = {name: SIGMA * random.normal(size=6) for name in PAIR}
    for leaving in (None, "left", None, "right", None):
        for _ in range(2):
            yield {name: None if name == leaving else update(name, e) for name, e in errors.items()}
        if leaving:
            errors[leaving] = SIGMA * random.normal(size=6)


def last_pose(tracker: ObjectTracker, steps: Steps) -> SplitGaussian:
    """The object after all steps."""
    for k, updates in enumerate(steps):
        found = tracker.step(k * STEP_NS, updates)
    assert found is not None and found.belief.pose is not None
    return found.belief.pose


def certainty(
    tracker: Callable[[], ObjectTracker],
    steps: Callable[[np.random.Generator], Steps],
    runs: int,
    given: bool = True,
) -> tuple[Array, float]:
    """Deviations of the box's middle (m) and rotation (rad), RMS over axes and runs, and NEES / 6.

    Without given places the object's frame is the first contact's.
    """
    random = np.random.default_rng(0)
    variances, total = np.zeros(2), 0.0
    frame = np.eye(4) if given else FEATURES["left"]  # the object's, in the box
    for _ in range(runs):
        pose = last_pose(tracker(), steps(random))
        middle = pose.mean @ se3.inverse(frame)
        ros = np.diagonal(ros_from_left(pose.cov, middle[:3, 3]))
        variances += ros[:3].mean(), ros[3:].mean()
        total += nees(OBJECT @ frame, pose.mean, pose.cov)
    return np.sqrt(variances / runs), total / (6 * runs)


def given_to(names: tuple[str, ...], **settings: float) -> Callable[[], ObjectTracker]:
    """Makes trackers that know where all contacts are."""
    places = {name: GIVEN[name] for name in names}
    return lambda: ObjectTracker(names, TrackerSettings(**settings), places)


def main() -> None:
    """Measure and print."""
    arguments = parser(__doc__ or "")
    arguments.add_argument("--runs", type=int, default=100, help="runs a row (100)")
    runs = arguments.parse_args().runs

    def holding(*names: str) -> Callable[[np.random.Generator], Steps]:
        return lambda random: together(names, 1, random)

    def found() -> ObjectTracker:
        return ObjectTracker(PAIR)

    rows = {
        "one, its place given": (given_to(("left",)), holding("left")),
        "two, places given": (given_to(PAIR), holding(*PAIR)),
        "three, places given": (given_to(THREE), holding(*THREE)),
        "two, given, `correlated_share` 0.5": (given_to(PAIR, correlated_share=0.5), holding(*PAIR)),
        "two, given, `correlated_share` 1": (given_to(PAIR, correlated_share=1.0), holding(*PAIR)),
        "two, places found by touch": (found, lambda random: together(PAIR, 4, random)),
        "the second of these, the first having let go": (found, handed_over),
        "both, after each let go once": (found, regrasped),
    }
    one, _ = certainty(given_to(("left",)), holding("left"), 1)
    table = Table(("contacts", "position", "rotation", "NEES / 6"), f"RMS and means of {runs} runs, seed 0")
    for name, (tracker, steps) in rows.items():
        sigma, honest = certainty(tracker, steps, runs, tracker is not found)
        table.row(name, *(f"{value:.2f}" for value in (*(sigma / one), honest)))


if __name__ == "__main__":
    main()
