"""OfflineBag: what the nodes of a run would have told, of one without ROS, in a recording that grows with it.

    with OfflineBag(folder / "bag", scene, task.name, plans) as bag:
        run_arms_offline(scene, task, options, log=bag.log)

The page shows it, and whatever else opens recordings. Times are those of the cell's clock.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base import topics
from tactile_base.origin import origin
from tactile_base.stamps import SECOND_NS
from tactile_base.topics import Topic
from tactile_bringup.graph import role_note
from tactile_bringup.offline_arm import START_NS
from tactile_bringup.run_sequence import ArmPlan
from tactile_control.phases import Command
from tactile_filter.belief import Belief
from tactile_filter.force import ForceGaussian
from tactile_perception.estimating.perceive import Percept
from tactile_records.bags.writer import BagWriter
from tactile_records.messages import (
    arm_status_bytes,
    bytes_from_array,
    force_bytes,
    pose_bytes,
    state_bytes,
    status_bytes,
    truth_bytes,
)
from tactile_records.runs.log import RunLog
from tactile_records.runs.record import RunRecord
from tactile_records.runs.surfaces import loose_body
from tactile_scene.arm import ArmMode, ArmState
from tactile_scene.scene import Scene
from tactile_sim.frame import Frame
from tactile_wire.cdr import blank_layout
from tactile_wire.packing import FRAME, gaussian_bytes, headed_bytes, split_stamp
from tactile_wire.pose_numbers import numbers_from_pose

Array = NDArray[np.float64]

STATUS_RATE, IMAGE_RATE, PATH_RATE = 30.0, 10.0, 2.0  # Hz, as nodes tell them, and as the page takes images
FLUSHED = 0.25  # s, between two times that what is written is handed over to whoever reads it
_OF_ARM = (
    topics.ARM_POSE, topics.ARM_STATUS, topics.CONTROLLER_STATUS, topics.JOINT_STATES, topics.PRESENCE,
    topics.ESTIMATE, topics.STATE, topics.TRUTH, topics.IMAGE, topics.PATH,
)  # fmt: skip


class OfflineBag:
    """See the module's text; a context. `BagError` where the folder is there or cannot be written."""

    def __init__(self, folder: Path, scene: Scene, task: str, plans: Sequence[ArmPlan], seed: int) -> None:
        self.folder, self._scene = folder, scene
        note = {
            "task": task,
            "scene": scene.name,
            "scene_file": str(scene.path.absolute()),
            "seed": str(seed),
            "roles": json.dumps({plan.arm: role_note(plan, scene) for plan in plans}),
            "origin": json.dumps(origin()),
        }
        told = [topic.of(plan.arm) for plan in plans for topic in _OF_ARM]
        self._writer = BagWriter(folder, [*told, topics.TF, topics.TF_STATIC], note=note)
        self._flushed = -FLUSHED
        bases = {topics.base_frame(name): arm.T_world_base for name, arm in scene.arms.items()}
        self.write(topics.TF_STATIC, START_NS, transforms_bytes(START_NS, bases))

    def __enter__(self) -> OfflineBag:
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.close()

    def log(self, record: RunRecord) -> RunLog:
        """Of one arm, written here as well."""
        return _ToldLog(record, self, loose_body(self._scene, record.arm))

    def write(self, topic: Topic, stamp_ns: int, data: bytes) -> None:
        """A message, in which `stamp_ns` is its time; what came before it can be read soon."""
        self._writer.write(topic.name, data, stamp_ns)
        if (now := time.monotonic()) - self._flushed > FLUSHED:
            self._flushed = now
            self._writer.flush()


def transforms_bytes(stamp_ns: int, children: dict[str, Array]) -> bytes:
    """TFMessage of frames in the world, T_world_child (4, 4)."""
    numbers, texts = list[float](), dict[str, str]()
    for k, (child, T) in enumerate(children.items()):
        texts |= {f"transforms.{k}.header.frame_id": topics.WORLD, f"transforms.{k}.child_frame_id": child}
        numbers += [*split_stamp(stamp_ns), *numbers_from_pose(T).tolist()]
    return blank_layout(topics.TF.type, texts, {"transforms": len(children)}).pack(*numbers)


class _ToldLog(RunLog):
    """Writes what it is told into a bag, too."""

    def __init__(self, record: RunRecord, bag: OfflineBag, body: str) -> None:
        super().__init__(record)
        self._bag, self._body = bag, body
        self._topics = {topic: topic.of(record.arm) for topic in _OF_ARM}
        self._base, self._sensor = topics.base_frame(record.arm), topics.sensor_frame(record.arm)
        self._mode: ArmMode | None = None
        self._due_ns = self._image_due_ns = self._path_due_ns = 0

    def _tell(self, topic: Topic, stamp_ns: int, data: bytes) -> None:
        self._bag.write(self._topics[topic], stamp_ns, data)

    def state(self, state: ArmState) -> None:
        """Where the arm is and what it does, as often as its node tells it."""
        super().state(state)
        if state.stamp_ns < self._due_ns and state.mode is self._mode:
            return
        self._mode, self._due_ns = state.mode, state.stamp_ns + round(SECOND_NS / STATUS_RATE)
        self._tell(topics.ARM_POSE, state.stamp_ns, pose_bytes(state, self._base))
        self._tell(topics.ARM_STATUS, state.stamp_ns, arm_status_bytes(state, self._base))
        if state.joints is not None:
            layout = blank_layout(topics.JOINT_STATES.type, None, {"position": len(state.joints)})
            numbers = *split_stamp(state.stamp_ns), *state.joints.tolist()
            self._tell(topics.JOINT_STATES, state.stamp_ns, layout.pack(*numbers))

    def exposure(self, frame: Frame) -> None:
        """The truth, and some images."""
        super().exposure(frame)
        self._tell(topics.TRUTH, frame.stamp_ns, truth_bytes(frame, self._base))
        if frame.image is not None and frame.stamp_ns >= self._image_due_ns:
            self._image_due_ns = frame.stamp_ns + round(SECOND_NS / IMAGE_RATE)
            data = bytes_from_array(frame.stamp_ns, self._sensor, frame.image)
            self._tell(topics.IMAGE, frame.stamp_ns, data)

    def body(self, stamp_ns: int, T_world_body: Array) -> None:
        """Where the body is that the arm touches."""
        super().body(stamp_ns, T_world_body)
        frames = {topics.body_frame(self._body): T_world_body}
        self._bag.write(topics.TF, stamp_ns, transforms_bytes(stamp_ns, frames))

    def percept(self, stamp_ns: int, percept: Percept) -> None:
        """Presence and estimate."""
        super().percept(stamp_ns, percept)
        numbers = percept.score, np.nan, bool(percept.in_contact), percept.still, percept.novelty
        data = headed_bytes(topics.PRESENCE.type, stamp_ns, self._sensor, *numbers)
        self._tell(topics.PRESENCE, stamp_ns, data)
        if percept.in_contact and percept.estimate is not None:
            mean, cov = percept.estimate.mean, percept.estimate.cov
            self._tell(topics.ESTIMATE, stamp_ns, gaussian_bytes(stamp_ns, self._sensor, mean, cov))

    def belief(self, belief: Belief) -> None:
        """What the filter believes."""
        super().belief(belief)
        data = state_bytes(belief, self._sensor, belief.stamp_ns)
        self._tell(topics.STATE, belief.stamp_ns, data)

    def force(self, stamp_ns: int, estimate: ForceGaussian, belief: ForceGaussian, nis: float) -> None:
        """What the network and the filter say of the force."""
        super().force(stamp_ns, estimate, belief, nis)
        self._tell(topics.FORCE_ESTIMATE, stamp_ns, force_bytes(stamp_ns, self._sensor, estimate))
        self._tell(topics.FORCE_BELIEF, stamp_ns, force_bytes(stamp_ns, self._sensor, belief, nis))

    def command(self, now_ns: int, goal: int, command: Command) -> None:
        """What the controller does."""
        super().command(now_ns, goal, command)
        named = goal, self.record.goals[goal]
        data = status_bytes(now_ns, self._sensor, self.record.task, named, command, command.twist, True)
        self._tell(topics.CONTROLLER_STATUS, now_ns, data)

    def ahead(self, now_ns: int, ahead: Callable[[], Sequence[Array]]) -> None:
        """Where the task leads."""
        if now_ns < self._path_due_ns:
            return
        self._path_due_ns = now_ns + round(SECOND_NS / PATH_RATE)
        numbers = [number for T in ahead() for number in numbers_from_pose(T).tolist()]
        layout = blank_layout(topics.PATH.type, {FRAME: self._base}, {"poses": len(numbers) // 7})
        self._tell(topics.PATH, now_ns, layout.pack(*split_stamp(now_ns), *numbers))
