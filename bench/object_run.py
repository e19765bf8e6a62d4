"""The belief over an object in a recorded run of simulated arms, against the truth.

    tactile launch surface_following --scene two_arms --object-belief two_arms --record my_bag
    python bench/object_run.py my_bag --given

The object stands still. With --given its frame is the world's, as config/objects/two_arms.yaml says; without,
the belief was made with --object-belief alone, and its frame is the true feature frame of the contact that
defined it, at that moment. For each part of the run: how many beliefs, how far they are off (RMS), NEES / 6
(1: as certain as claimed), and how far the true feature frame of each contact has moved: how far it slid.
"""

from __future__ import annotations

import argparse
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_bringup.bag import Bag, read_bag
from tactile_bringup.bag_reader import arms_of, gaussian_row, pose_matrix, run_from_bag, stamp_of, truth_row
from tactile_drivers.scene import load_scene
from tactile_filter import se3
from tactile_filter.consistency import nees

Array = NDArray[Any]
GAP_NS = 300_000_000  # after a longer silence the object's frame may be another one
SECOND_NS = 1_000_000_000


@dataclass(frozen=True)
class Features:
    """The true feature frames (N, 4, 4) of one arm's contact in the world, while it touches."""

    stamp_ns: Array
    T_world_feature: Array

    def at(self, stamp_ns: int) -> Array:
        """The pose (4, 4) at the exposure nearest to a stamp."""
        return self.T_world_feature[np.abs(self.stamp_ns - stamp_ns).argmin()]


@dataclass(frozen=True)
class Belief:
    """One message of object/belief, with the true pose of the frame that it is about."""

    stamp_ns: int
    mean: Array
    cov: Array
    truth: Array


def features_of(bag: Bag, arm: str) -> Features:
    """From the simulator's truth."""
    base = load_scene(bag.note["scene_file"]).arms[arm].T_world_base
    stamps, poses = [], []
    for _, message in bag.decoded(f"/{arm}/sim/truth"):
        if message.in_contact:
            stamps.append(stamp_of(message))
            poses.append(base @ pose_matrix(message.pose) @ se3.inverse(truth_row(message)["T_fs"]))
    return Features(np.array(stamps), np.array(poses))


def beliefs_of(bag: Bag, features: dict[str, Features], given: bool) -> list[Belief]:
    """All of them; without given places the frame is that of the feature nearest to the first after a gap."""
    found: list[Belief] = []
    truth = np.eye(4)
    for _, message in bag.decoded("/object/belief"):
        row = gaussian_row(message)
        if not given and (not found or row["stamp_ns"] - found[-1].stamp_ns > GAP_NS):
            nearest = [each.at(row["stamp_ns"]) for each in features.values()]
            truth = min(nearest, key=lambda T: float(np.linalg.norm(T[:3, 3] - row["mean"][:3, 3])))
        found.append(Belief(row["stamp_ns"], row["mean"], row["cov"], truth))
    return found


def parts_of(bag: Bag, arm: str, bounds_mm: list[float], features: Features) -> dict[str, tuple[int, int]]:
    """Name -> first and last stamp: settling, and following by how far the arm's contact slid till then."""
    record = run_from_bag(bag, arm)
    phases = record.command.phase
    stamps = record.command.stamp_ns
    parts = {}
    settle = stamps[phases == "settle"]
    parts["hold"] = int(settle[0]) + SECOND_NS // 2, int(settle[-1])
    follow = stamps[phases == "follow"]
    start = features.at(int(follow[0]))[:3, 3]
    slid = 1e3 * np.linalg.norm(features.T_world_feature[:, :3, 3] - start, axis=1)
    during = (features.stamp_ns >= follow[0]) & (features.stamp_ns <= follow[-1])
    edges = [0.0, *bounds_mm, np.inf]
    for low, high in itertools.pairwise(edges):
        inside = features.stamp_ns[during & (slid >= low) & (slid < high)]
        if len(inside):
            parts[f"follow, slid {low:g} to {high:g} mm"] = int(inside[0]), int(inside[-1])
    return parts


def print_part(
    name: str, span: tuple[int, int], beliefs: list[Belief], features: dict[str, Features]
) -> None:
    """One row of the table."""
    first, last = span
    within = [each for each in beliefs if first <= each.stamp_ns <= last]
    slid = [f"{arm} {slid_mm(feature, first, last):.1f}" for arm, feature in features.items()]
    cells = [name, f"{(last - first) / SECOND_NS:.1f}", f"{len(within)}", *errors_of(within), ", ".join(slid)]
    print(f"| {' | '.join(cells)} |")


def slid_mm(features: Features, first: int, last: int) -> float:
    """How far the true feature frame has moved between two stamps."""
    return 1e3 * float(np.linalg.norm((features.at(last) - features.at(first))[:3, 3]))


def errors_of(beliefs: list[Belief]) -> list[str]:
    """RMS of position (mm) and rotation (degrees), and NEES / 6; blanks where there is no belief."""
    if not beliefs:
        return ["", "", ""]
    off = [each.mean[:3, 3] - each.truth[:3, 3] for each in beliefs]
    turned = [se3.rotation_vector(each.mean[:3, :3] @ each.truth[:3, :3].T) for each in beliefs]
    position, rotation = (float(np.sqrt(np.mean(np.sum(np.square(v), axis=1)))) for v in (off, turned))
    honest = np.mean([nees(each.truth, each.mean, each.cov) for each in beliefs]) / 6.0
    return [f"{1e3 * position:.2f}", f"{np.degrees(rotation):.2f}", f"{honest:.2f}"]


def print_latency(bag: Bag) -> None:
    """From the newest exposure to the belief, and what the node lost."""
    seconds, dropped = [], 0
    for _, message in bag.decoded("/object/latency"):
        for exposed, emitted, lost in zip(message.exposed, message.emitted, message.dropped, strict=True):
            seconds.append(emitted.sec - exposed.sec + 1e-9 * (emitted.nanosec - exposed.nanosec))
            dropped = max(dropped, int(lost))
    if seconds:
        median, high = 1e3 * np.percentile(seconds, (50, 99))
        print(f"\nexposure to belief: p50 {median:.1f} ms, p99 {high:.1f} ms; dropped: {dropped}")


def main() -> int:
    """Print the table in Markdown; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("bag", type=Path, help="a bag of a launch with --object-belief")
    parser.add_argument("--given", action="store_true", help="places were given, in the world's frame")
    parser.add_argument("--bounds", type=float, nargs="*", default=[0.5, 5.0], help="of the slid way, mm")
    arguments = parser.parse_args()
    bag = read_bag(arguments.bag)
    features = {arm: features_of(bag, arm) for arm in arms_of(bag)}
    beliefs = beliefs_of(bag, features, arguments.given)
    first = next(iter(features))
    print("| part | s | beliefs | position, mm | rotation, deg | NEES / 6 | contacts slid, mm |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, span in parts_of(bag, first, arguments.bounds, features[first]).items():
        print_part(name, span, beliefs, features)
    print_latency(bag)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
