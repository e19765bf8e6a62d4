"""The belief over an object that two simulated arms touch, against the truth.

    python bench/object_run.py [--given] [--fidelity ideal]     # without ROS, on the scene two_arms
    python bench/object_run.py --bag my_bag [--given]           # of nodes:
        tactile launch surface_following --scene two_arms --object-belief [two_arms] --record my_bag

The object stands still. With --given its frame is the world's, as config/objects/two_arms.yaml says; without,
places are found by touch, and it is the true feature frame of the contact that defined it, at that moment.
For each part of the run: how many beliefs, how far they are off (RMS), NEES / 6 (1: as certain as claimed),
and how far the true feature frame of each contact has moved: how far it slid.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import config_path
from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_filter.consistency import nees
from tactile_filter.object.settings import TrackerSettings, load_object
from tactile_filter.object.tracker import ContactUpdate, ObjectTracker
from tactile_geometry import se3
from tactile_geometry.gaussian import PoseGaussian
from tactile_records.bags.reader import Bag, read_bag
from tactile_records.runs.from_bag import (
    arms_of,
    gaussian_row,
    pose_matrix,
    run_from_bag,
    stamp_of,
    truth_row,
)
from tactile_records.runs.record import RunRecord
from tactile_scene.scene import Scene
from tactile_scene.scene_file import load_scene

Array = NDArray[Any]
GAP_NS = 300_000_000  # after a longer silence the object's frame may be another one
SETTLED_NS = SECOND_NS // 2  # of holding is not looked at: the arms are still pressing


@dataclass(frozen=True)
class Features:
    """The true feature frames (N, 4, 4) of one arm's contact in the world, while it touches."""

    stamp_ns: Array
    T_world_feature: Array

    def at(self, stamp_ns: int) -> Array:
        """The pose (4, 4) at the exposure nearest to a stamp."""
        return self.T_world_feature[np.abs(self.stamp_ns - stamp_ns).argmin()]

    def slid_mm(self, first_ns: int, last_ns: int) -> float:
        """How far the frame has moved between two stamps."""
        return 1e3 * float(np.linalg.norm((self.at(last_ns) - self.at(first_ns))[:3, 3]))


@dataclass(frozen=True)
class Believed:
    """One belief over the object."""

    stamp_ns: int
    mean: Array
    cov: Array


@dataclass(frozen=True)
class Run:
    """What both sources give: each arm's record and true contact, and the beliefs over the object."""

    records: dict[str, RunRecord]
    features: dict[str, Features]
    beliefs: list[Believed]


# ---- without ROS ----


def offline(given: bool, fidelity: str, seed: int, settings: dict[str, float]) -> Run:
    """Each arm's task on its own, which does not know of the other; then the tracker on both."""
    scene = load_scene("two_arms")
    records = {
        arm: run_offline(scene, options=OfflineOptions(fidelity=fidelity, seed=seed + k, arm=arm))
        for k, arm in enumerate(scene.arms)
    }
    features = {arm: _features_of(record, scene) for arm, record in records.items()}
    return Run(records, features, list(_track(records, scene, given, settings)))


def _features_of(record: RunRecord, scene: Scene) -> Features:
    touching = record.truth.rows(record.truth.in_contact)
    sensors = _sensors(record, scene, touching.stamp_ns)
    return Features(touching.stamp_ns, sensors @ np.linalg.inv(touching.T_fs))


def _sensors(record: RunRecord, scene: Scene, stamp_ns: Array) -> Array:
    """T_world_sensor (N, 4, 4) at exposures; a pose is recorded at each of them."""
    at = np.searchsorted(record.pose.stamp_ns, stamp_ns)
    assert (record.pose.stamp_ns[at] == stamp_ns).all()
    return scene.arms[record.arm].T_world_base @ record.pose.T_base_sensor[at]


def _track(
    records: dict[str, RunRecord], scene: Scene, given: bool, settings: dict[str, float]
) -> Iterator[Believed]:
    """The object at each exposure; an arm that has no belief then has no contact."""
    _, places = load_object(config_path("objects/two_arms.yaml"), list(records))
    known = {arm: place.place() for arm, place in places.items()} if given else {}
    tracker = ObjectTracker(list(records), TrackerSettings(**settings), known)
    updates: dict[int, dict[str, ContactUpdate | None]] = {}
    for arm, record in records.items():
        for stamp_ns in record.truth.stamp_ns.tolist():
            updates.setdefault(stamp_ns, {})[arm] = None
        belief = record.belief
        sensors = _sensors(record, scene, belief.stamp_ns)
        for stamp_ns, mean, cov, sensor in zip(
            belief.stamp_ns.tolist(), belief.mean, belief.cov, sensors, strict=True
        ):
            updates[stamp_ns][arm] = ContactUpdate(PoseGaussian(mean, cov), sensor)
    for stamp_ns in sorted(updates):
        found = tracker.step(stamp_ns, updates[stamp_ns])
        if found is not None and found.belief.pose is not None:
            pose = found.belief.pose
            yield Believed(stamp_ns, pose.mean, pose.cov)


# ---- from a bag ----


def recorded(bag: Bag) -> Run:
    """What the nodes said."""
    scene = load_scene(bag.note["scene_file"])
    records = {arm: run_from_bag(bag, arm) for arm in arms_of(bag)}
    features = {}
    for arm in records:
        base = scene.arms[arm].T_world_base
        rows = [
            (stamp_of(message), base @ pose_matrix(message.pose) @ se3.inverse(truth_row(message)["T_fs"]))
            for _, message in bag.decoded(f"/{arm}/sim/truth")
            if message.in_contact
        ]
        if not rows:
            raise SystemExit(f"{bag.folder}: arm '{arm}' touches nothing in this bag")
        stamps, poses = zip(*rows, strict=True)
        features[arm] = Features(np.array(stamps), np.array(poses))
    beliefs = [Believed(**gaussian_row(message)) for _, message in bag.decoded("/object/belief")]
    return Run(records, features, beliefs)


def print_latency(bag: Bag) -> None:
    """From the newest exposure to the belief, and what the node lost."""
    seconds, dropped = [], 0
    for _, message in bag.decoded("/object/latency"):
        for exposed, emitted, lost in zip(message.exposed, message.emitted, message.dropped, strict=True):
            seconds.append(emitted.sec - exposed.sec + 1e-9 * (emitted.nanosec - exposed.nanosec))
            dropped = max(dropped, int(lost))
    median, high = 1e3 * np.percentile(seconds, (50, 99))
    print(f"\nexposure to belief: p50 {median:.1f} ms, p99 {high:.1f} ms; dropped: {dropped}")


# ---- numbers ----


def parts_of(run: Run, bounds_mm: list[float]) -> dict[str, tuple[int, int]]:
    """Name -> first and last stamp: holding, and following by how far the first arm's contact slid."""
    record, features = next(zip(run.records.values(), run.features.values(), strict=True))
    stamps, phases = record.command.stamp_ns, record.command.phase
    hold, follow = (stamps[phases == phase] for phase in ("settle", "follow"))
    parts = {"hold": (int(hold[0]) + SETTLED_NS, int(hold[-1]))}
    if not len(follow):
        return parts
    start = features.at(int(follow[0]))[:3, 3]
    slid = 1e3 * np.linalg.norm(features.T_world_feature[:, :3, 3] - start, axis=1)
    during = (features.stamp_ns >= follow[0]) & (features.stamp_ns <= follow[-1])
    for low, high in itertools.pairwise([0.0, *bounds_mm, np.inf]):
        inside = features.stamp_ns[during & (slid >= low) & (slid < high)]
        if len(inside):
            parts[f"follow, slid {low:g} to {high:g} mm"] = int(inside[0]), int(inside[-1])
    return parts


def truths_of(run: Run, given: bool) -> list[Array]:
    """The true pose of the frame of each belief.

    Without given places it is that of the feature which is nearest to the first belief after a gap.
    """
    truth, last_ns, found = np.eye(4), -GAP_NS - 1, []
    for belief in run.beliefs:
        if not given and belief.stamp_ns - last_ns > GAP_NS:
            near = [features.at(belief.stamp_ns) for features in run.features.values()]
            truth = min(near, key=lambda T: float(np.linalg.norm(T[:3, 3] - belief.mean[:3, 3])))
        last_ns = belief.stamp_ns
        found.append(truth)
    return found


def errors_of(beliefs: list[Believed], truths: list[Array]) -> list[str]:
    """RMS of position (mm) and rotation (degrees), and NEES / 6; blanks where there is no belief."""
    if not beliefs:
        return ["", "", ""]
    pairs = list(zip(beliefs, truths, strict=True))
    off = [each.mean[:3, 3] - truth[:3, 3] for each, truth in pairs]
    turned = [se3.log(each.mean @ se3.inverse(truth))[3:] for each, truth in pairs]
    position, rotation = (float(np.sqrt(np.mean(np.sum(np.square(v), axis=1)))) for v in (off, turned))
    honest = np.mean([nees(truth, each.mean, each.cov) for each, truth in pairs]) / 6.0
    return [f"{1e3 * position:.2f}", f"{np.degrees(rotation):.2f}", f"{honest:.2f}"]


def print_table(run: Run, given: bool, bounds_mm: list[float]) -> None:
    """One row a part of the run, in Markdown."""
    truths = truths_of(run, given)
    print("| part | s | beliefs | position, mm | rotation, deg | NEES / 6 | contacts slid, mm |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for name, (first, last) in parts_of(run, bounds_mm).items():
        inside = [k for k, each in enumerate(run.beliefs) if first <= each.stamp_ns <= last]
        errors = errors_of([run.beliefs[k] for k in inside], [truths[k] for k in inside])
        slid = ", ".join(f"{f.slid_mm(first, last):.1f}" for f in run.features.values())
        cells = [name, f"{(last - first) / SECOND_NS:.1f}", f"{len(inside)}", *errors, slid]
        print(f"| {' | '.join(cells)} |")


def main() -> int:
    """Print the numbers; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bag", type=Path, help="of a launch with --object-belief")
    parser.add_argument("--given", action="store_true", help="places are given, in the world's frame")
    parser.add_argument("--fidelity", choices=("image", "ideal"), default="image")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--slide-shear", type=float, help="setting slide_shear of the tracker")
    parser.add_argument("--bounds", type=float, nargs="*", default=[0.5, 2.0], help="of the slid way, mm")
    options = parser.parse_args()
    bag = None if options.bag is None else read_bag(options.bag)
    if bag is None:
        settings = {} if options.slide_shear is None else {"slide_shear": options.slide_shear}
        run = offline(options.given, options.fidelity, options.seed, settings)
    else:
        run = recorded(bag)
    print_table(run, options.given, options.bounds)
    if bag is not None:
        print_latency(bag)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
