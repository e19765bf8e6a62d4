"""The closed loop without ROS: simulated cell, estimator, filter and task in one process, as fast as it goes.

The same libraries as the nodes use, in the order in which the graph would call them, on the cell's own clock.
What the pipeline would take is simulated: the controller acts on an exposure `latency` seconds after it. The
same scene, task, options and seed give the same bits::

    record = run_offline("ramp", "surface_following", OfflineOptions(fidelity="ideal", seed=1))
    values = metrics.report(record)
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tactile_base.settings import SettingError
from tactile_control.files import Task, load_task, task_path
from tactile_control.phases import StampedPose
from tactile_control.task import Command, StampedPresence, SurfaceFollowing, TaskInputs
from tactile_drivers.scene import Scene, load_scene
from tactile_drivers.sim.cell import Cell, Frame
from tactile_filter.bayes_filter import Belief, BeliefFlag, ContactFilter, FilterSettings
from tactile_filter.files import load_filter_settings
from tactile_filter.gaussian import PoseGaussian
from tactile_records.runs.record import (
    ArmSeries,
    BeliefSeries,
    CommandSeries,
    GaussianSeries,
    PoseSeries,
    PresenceSeries,
    RunRecord,
    StageSeries,
    TruthSeries,
)
from tactile_records.runs.surfaces import surface_mesh

Array = NDArray[Any]

SECOND_NS = 1_000_000_000
START_NS = SECOND_NS  # stamp of the cell's first state; 0 stands for "no stamp" in records
CONTROLLER = "controller"


@dataclass(frozen=True)
class OfflineOptions:
    """How to run.

    Attributes
    ----------
    fidelity : str or None
        "image" (skin, camera image, network) or "ideal" (noisy truth); None: as the scene says.
    model : Path or None
        ONNX model for images; None: the shipped one.
    latency : float
        From exposure to command emission, s.
    jitter : float
        Uniform part added to each latency, s.
    control_period : float
        The controller also steps when nothing arrived for this long, s.
    arm : str or None
        Which arm runs the task; None: the scene's only one.
    paths : tuple of str
        Names of the paths to run; empty: all.
    time_limit : float
        A path that takes longer than this on the cell's clock is given up, s.
    sensor : dict
        Settings of the sensor's model that replace the scene's.
    """

    fidelity: str | None = None
    model: Path | None = None
    seed: int = 0
    latency: float = 0.010
    jitter: float = 0.0
    control_period: float = 0.010
    arm: str | None = None
    paths: tuple[str, ...] = ()
    time_limit: float = 180.0
    filter: FilterSettings = field(default_factory=load_filter_settings)
    sensor: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Percept:
    """What perception says of one exposure; None while it cannot say anything yet."""

    in_contact: bool | None
    score: float
    estimate: PoseGaussian | None


class Perception(Protocol):
    """Turns the exposure of a frame into a percept."""

    def __call__(self, frame: Frame) -> Percept:
        """The percept of one frame."""


class IdealPerception:
    """For sensors of fidelity "ideal": the frame's own estimate, and contact from the truth."""

    def __call__(self, frame: Frame) -> Percept:
        return Percept(frame.truth.in_contact, float(frame.truth.in_contact), frame.estimate)


class ImagePerception:
    """For camera images: contact presence and the network, as in the estimator node."""

    def __init__(self, model: Path | None) -> None:
        # here, since runs with an ideal sensor do without onnxruntime
        from tactile_perception.estimating.presence import ContactPresence
        from tactile_perception.estimator import Estimator

        self.estimator = Estimator(model or "")
        self.presence = ContactPresence()

    def __call__(self, frame: Frame) -> Percept:
        assert frame.image is not None
        prepared = self.estimator.preprocessor(frame.image)
        presence = self.presence.update(prepared)
        if presence.in_contact is None:
            return Percept(None, presence.score, None)
        return Percept(presence.in_contact, presence.score, self.estimator.estimate_prepared(prepared))


@dataclass(frozen=True)
class Event:
    """A finished exposure on its way to the controller, which sees it at `due_ns`."""

    due_ns: int
    stamp_ns: int
    presence: StampedPresence
    belief: StampedPose | None


def run_offline(
    scene: Scene | str,
    task: Task | str = "surface_following",
    options: OfflineOptions | None = None,
    progress: Callable[[str, Command], None] | None = None,
) -> RunRecord:
    """Run all paths of a task on a scene and return what happened.

    Parameters
    ----------
    scene, task
        Loaded, or by name (config/scenes, config/tasks).
    progress : callable
        Told the path's name and the command after each step of the controller.

    Raises
    ------
    SettingError, FileNotFoundError
        For scenes, tasks, arms and paths that do not exist or hold something wrong.
    """
    options = options or OfflineOptions()
    scene = load_scene(scene) if isinstance(scene, str) else scene
    if options.fidelity is not None:
        scene = scene.with_fidelity(options.fidelity, **options.sensor)
    task = load_task(task_path(task), scene.name) if isinstance(task, str) else task
    return _OfflineLoop(scene, task, options, progress).run()


class _OfflineLoop:
    """Cell, perception, filter and controller on the cell's clock."""

    def __init__(
        self,
        scene: Scene,
        task: Task,
        options: OfflineOptions,
        progress: Callable[[str, Command], None] | None,
    ) -> None:
        self.task, self.options, self.progress = task, options, progress
        self.arm = _arm_name(scene, options.arm)
        self.start = scene.arms[self.arm].T_base_start
        self.goals = _chosen(task.goals(self.start), options.paths)
        self.cell = Cell(scene, options.seed, START_NS)
        self.perceive = _perception(scene, self.arm, options)
        self.filter = ContactFilter(options.filter)
        self.random = np.random.default_rng(options.seed)
        self.log = _Log(scene, task, self.arm, options, [goal.name for goal in self.goals])
        self.queue: deque[Event] = deque()
        self.inputs = TaskInputs()
        self.stepped_ns = START_NS

    def run(self) -> RunRecord:
        started = time.perf_counter()
        last: Command | None = None
        for index, goal in enumerate(self.goals):
            last = self._run_path(index, goal.name, SurfaceFollowing(self.task.settings, goal))
            if not last.succeeded:
                break
        assert last is not None
        reason = "" if last.succeeded else f"{goal.name}: {last.reason or 'took too long'}"
        return self.log.record(last.succeeded, reason, time.perf_counter() - started)

    def _run_path(self, index: int, name: str, task: SurfaceFollowing) -> Command:
        deadline_ns = self.cell.stamp_ns + round(self.options.time_limit * SECOND_NS)
        command = None
        while command is None or not (command.done or self.cell.stamp_ns > deadline_ns):
            self._take_pose()
            now_ns = self.cell.step()
            due = self._due(now_ns)
            for event in due:
                command = self._step(task, index, event.due_ns, event)
            if not due and now_ns - self.stepped_ns >= self.options.control_period * SECOND_NS:
                command = self._step(task, index, now_ns, None)
            if self.progress is not None and command is not None:
                self.progress(name, command)
            if self.cell.exposure_due(self.arm):
                self._expose()
        return command

    def _take_pose(self) -> None:
        """What the arm reports at this step; the controller sees it from the next one on."""
        pose = StampedPose(self.cell.stamp_ns, self.cell.T_base_sensor(self.arm))
        self.inputs = TaskInputs(self.inputs.belief, self.inputs.presence, pose)
        self.log.pose(pose, self.cell.status(self.arm).twist)

    def _due(self, now_ns: int) -> list[Event]:
        due = []
        while self.queue and self.queue[0].due_ns <= now_ns:
            due.append(self.queue.popleft())
        return due

    def _step(self, task: SurfaceFollowing, index: int, now_ns: int, event: Event | None) -> Command:
        if event is not None:
            belief = event.belief or self.inputs.belief
            self.inputs = TaskInputs(belief, event.presence, self.inputs.sensor_pose)
        command = task.step(now_ns, self.inputs)
        self.cell.command(self.arm, now_ns, command.twist)
        self.log.command(now_ns, index, command)
        if event is not None:
            self.log.latency(event.stamp_ns, now_ns)
        self.stepped_ns = now_ns
        return command

    def _expose(self) -> None:
        """One exposure through perception and filter, as the estimator and filter nodes do it."""
        frame = self.cell.expose(self.arm)
        percept = self.perceive(frame)
        self.log.frame(frame, percept)
        if percept.in_contact is None:
            return
        belief: Belief | None = None
        if percept.in_contact and percept.estimate is not None:
            belief = self.filter.step(frame.stamp_ns, percept.estimate, frame.T_base_sensor)
            belief = belief if belief.valid else None
        if belief is not None:
            self.log.belief(belief)
        elif not percept.in_contact and self.filter.has_belief:
            self.filter.reset("no contact")
        self.queue.append(self._event(frame.stamp_ns, percept.in_contact, belief))

    def _event(self, stamp_ns: int, in_contact: bool, belief: Belief | None) -> Event:
        latency = self.options.latency + self.options.jitter * float(self.random.random())
        due_ns = stamp_ns + round(latency * SECOND_NS)
        if self.queue:
            due_ns = max(due_ns, self.queue[-1].due_ns)  # a chain of nodes keeps the order
        pose = StampedPose(stamp_ns, belief.mean) if belief is not None else None
        return Event(due_ns, stamp_ns, StampedPresence(stamp_ns, in_contact), pose)


class _Log:
    """Collects rows and makes the `RunRecord` of them."""

    def __init__(self, scene: Scene, task: Task, arm: str, options: OfflineOptions, paths: list[str]) -> None:
        self.rows: dict[str, list[tuple[Any, ...]]] = {
            name: []
            for name in ("pose", "arm", "truth", "presence", "estimate", "belief", "command", "latency")
        }
        self.base = RunRecord(
            scene=scene.name,
            task=task.name,
            arm=arm,
            source="offline",
            seed=options.seed,
            reference=np.array(task.settings.servoing.reference),
            paths=paths,
            surface=surface_mesh(scene, arm),
        )

    def pose(self, pose: StampedPose, twist: Array) -> None:
        self.rows["pose"].append((pose.stamp_ns, pose.T))
        self.rows["arm"].append((pose.stamp_ns, twist))

    def frame(self, frame: Frame, percept: Percept) -> None:
        truth, stamp = frame.truth, frame.stamp_ns
        self.rows["truth"].append((stamp, truth.T_fs, truth.slip_fraction, truth.in_contact))
        self.rows["presence"].append((stamp, percept.score, bool(percept.in_contact)))
        if percept.in_contact and percept.estimate is not None:
            self.rows["estimate"].append((stamp, percept.estimate.mean, percept.estimate.cov))

    def belief(self, belief: Belief) -> None:
        fused = bool(belief.flags & BeliefFlag.MEASUREMENT_FUSED)
        row = (belief.stamp_ns, belief.mean, belief.cov, belief.nis, belief.nis_dof, fused)
        self.rows["belief"].append(row)

    def command(self, now_ns: int, path: int, command: Command) -> None:
        row = (command.twist, command.unlimited, command.error, command.feedforward, command.phase)
        self.rows["command"].append((now_ns, *row, path, command.exposure_ns))

    def latency(self, stamp_ns: int, now_ns: int) -> None:
        self.rows["latency"].append((stamp_ns, (now_ns - stamp_ns) / SECOND_NS))

    def record(self, succeeded: bool, reason: str, wall_s: float) -> RunRecord:
        record = self.base
        record.pose = PoseSeries(*_columns(self.rows["pose"]))
        record.arm_twist = ArmSeries(*_columns(self.rows["arm"]))
        record.truth = TruthSeries(*_columns(self.rows["truth"]))
        record.presence = PresenceSeries(*_columns(self.rows["presence"]))
        record.estimate = GaussianSeries(*_columns(self.rows["estimate"]))
        record.belief = BeliefSeries(*_columns(self.rows["belief"]))
        record.command = CommandSeries(*_columns(self.rows["command"]))
        record.latency = {CONTROLLER: StageSeries(*_columns(self.rows["latency"]))}
        record.lost = {CONTROLLER: 0}
        record.result = {"succeeded": succeeded, "reason": reason, "wall_s": wall_s}
        return record


def _columns(rows: list[tuple[Any, ...]]) -> list[Array]:
    return [np.array(column) for column in zip(*rows, strict=True)]


def _arm_name(scene: Scene, wanted: str | None) -> str:
    names = [name for name, arm in scene.arms.items() if arm.sensor is not None]
    if wanted is None and len(names) == 1:
        return names[0]
    if wanted not in names:
        raise SettingError(
            f"scene {scene.name}: --arm must name an arm with a sensor; there are: {', '.join(names)}"
        )
    return wanted


def _chosen(goals: tuple[Any, ...], names: tuple[str, ...]) -> tuple[Any, ...]:
    known = [goal.name for goal in goals]
    for name in names:
        if name not in known:
            raise SettingError(f"path '{name}' does not exist; valid: {', '.join(known)}")
    return tuple(goal for goal in goals if not names or goal.name in names)


def _perception(scene: Scene, arm: str, options: OfflineOptions) -> Perception:
    return (
        ImagePerception(options.model or scene.model_file(arm))
        if scene.gives_images(arm)
        else IdealPerception()
    )
