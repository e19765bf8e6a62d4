"""One arm of a run without ROS: its perception, filter and task, and what its nodes would count."""

from __future__ import annotations

import dataclasses
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from tactile_base.origin import origin
from tactile_base.raised import plugin_name
from tactile_base.settings import SettingGroups
from tactile_base.stamps import NANOSECOND, SECOND_NS
from tactile_bringup.offline_perception import Perception
from tactile_bringup.run_sequence import ArmPlan
from tactile_control.force_reference import StampedForce
from tactile_control.partners import Partners
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import Command, StampedPose, StampedPresence, TaskInputs
from tactile_control.task_step import task_step
from tactile_doubles.lies import Lies
from tactile_drivers.arm_distance import neighbours
from tactile_drivers.safety import SafeArm
from tactile_filter.bayes_filter import ContactFilter
from tactile_filter.contact_bounds import TACTIP
from tactile_filter.filter_settings import FilterSettings, load_filter_settings
from tactile_filter.force import ForceFilter
from tactile_perception.estimating.image import ImageError
from tactile_perception.estimating.image_check import ImageCheckSettings
from tactile_perception.estimating.perceive import DepthAgreement, Percept
from tactile_records.runs.log import RunLog
from tactile_records.runs.record import RunRecord
from tactile_records.runs.surfaces import loose_body, loose_outline, surface_mesh
from tactile_scene.arm import ArmMode
from tactile_scene.scene import Scene
from tactile_sim.cell import Cell
from tactile_sim.frame import Frame

DEPTH_DIFFERENCE = ImageCheckSettings().depth_difference  # m, as the estimator node has it
START_NS = SECOND_NS  # stamp of the cell's first state; 0 stands for "no stamp" in records

Log = Callable[[RunRecord], RunLog]


@dataclass(frozen=True)
class OfflineOptions:
    """How to run.

    Attributes
    ----------
    fidelity : of all sensors, one of `FIDELITIES`; None: as the scene says
    model : ONNX model for images; None: that of each sensor in the scene
    latency : from exposure to command emission, s
    jitter : uniform part added to each latency, s
    control_period : a controller also steps when nothing arrived for this long, s
    arm : only this arm runs; None: all that have a role
    goals : names of the goals to run; empty: all
    time_limit : a goal that takes longer than this on the cell's clock is given up, s
    work_time : so long after the last arm has come to its work all are asked to finish, s
    sensor : settings of the sensor's model that replace the scene's
    lies : what does not tell the truth; None: nothing
    """

    fidelity: str | None = None
    model: Path | None = None
    seed: int = 0
    latency: float = 0.010
    jitter: float = 0.0
    control_period: float = 0.010
    arm: str | None = None
    goals: tuple[str, ...] = ()
    time_limit: float = 180.0
    work_time: float = math.inf
    filter: FilterSettings = field(default_factory=load_filter_settings)
    sensor: dict[str, Any] = field(default_factory=dict)
    lies: Lies | None = None


def _given(controller: SettingGroups, options: OfflineOptions) -> dict[str, dict[str, Any]]:
    """Settings of a run, as a recording of nodes has them; those of the run itself under `simulation`."""
    run = {"fidelity": options.fidelity or "of the scene", "latency": options.latency, **options.sensor}
    run |= {"model": str(options.model)} if options.model else {}
    return {
        "controller": controller.dotted(),
        "filter": dataclasses.asdict(options.filter),
        "simulation": run,
    }


@dataclass(frozen=True)
class _Event:
    """A finished exposure on its way to the controller, which sees it at `due_ns`."""

    due_ns: int
    presence: StampedPresence
    belief: StampedPose | None
    force: StampedForce | None = None


class OfflineArm:
    """One arm with its perception, filter and task."""

    def __init__(
        self,
        scene: Scene,
        task: str,
        plan: ArmPlan,
        cell: Cell,
        options: OfflineOptions,
        number: int,
        perceive: Perception | None,
        log: Log,
    ) -> None:
        self.plan, self.cell, self.options = plan, cell, options
        self.safe = SafeArm(scene.arms[plan.arm], lambda: cell.stamp_ns)
        self.lies = options.lies or Lies()
        self.driver = self.lies.driver(plan.arm, cell.arm(plan.arm))
        self.safe.attach_driver(self.driver)
        self.safe.neighbours = neighbours(scene, plan.arm, cell.status, cell.arms)
        sensor = scene.arms[plan.arm].sensor
        self.perceive = perceive
        self.filter, self.forces = ContactFilter(options.filter, TACTIP), ForceFilter()
        self.random = np.random.default_rng([options.seed, number] if number else options.seed)
        self.log = log(
            RunRecord(
                scene=scene.name,
                task=plan.role.task,
                task_file=task,
                arm=plan.arm,
                role=plan.role.name,
                work=plan.role.task_type.work,
                source="offline",
                seed=options.seed,
                goals=[goal.name for goal in plan.goals],
                tip_radius=sensor.settings.tip_radius if sensor is not None else 0.0,
                targets=plan.targets,
                directions=plan.directions,
                T_world_base=scene.arms[plan.arm].T_world_base,
                T_controlled_sensor=scene.T_controlled_sensor(plan.arm),
                loose=loose_outline(scene, plan.arm),
                surface=surface_mesh(scene, plan.arm),
                settings=_given(plan.role.settings, options),
                origin=origin(),
            )
        )
        self.loose = loose_body(scene, plan.arm)
        self.queue: deque[_Event] = deque()
        self.inputs = TaskInputs()
        self.stepped_ns = START_NS
        self.refused = Counter[str]()
        self.agreement = DepthAgreement()  # of what lies may have changed
        self.remark = ""
        self.partners, self.traceback = Partners(), ""
        self.task: PhaseMachine | None = None
        self.goal = 0
        self.begun_ns = START_NS

    @property
    def goal_name(self) -> str:
        return self.plan.goals[self.goal].name

    def begin(self, index: int) -> None:
        """Start a goal."""
        role, named = self.plan.role, self.plan.goals[index]
        make: Any = role.task_type
        self.task = make(role.settings, named.goal, named.start)
        self.task.T_world_base = self.log.record.T_world_base
        self.goal, self.begun_ns = index, self.cell.stamp_ns
        self.partners.begin()

    def end(self, failure: str) -> None:
        """Have the task end, since the run is over: well, unless that was a failure."""
        assert self.task is not None
        if failure:
            self.task.stop(f"the run has failed: {failure}")
        else:
            self.task.finish()

    def over_time(self, now_ns: int) -> bool:
        """Whether a goal that ends by itself has not done so in time."""
        limit = self.options.time_limit * SECOND_NS
        return not self.plan.role.task_type.endless and now_ns - self.begun_ns > limit

    @property
    def late(self) -> str:
        """What is said of a goal that was over time."""
        whose = plugin_name(self.plan.role.task_type)
        more = f": {whose} has not ended {self.options.time_limit:g} s after it began" if whose else ""
        return f"took too long{more}"

    def take_pose(self) -> None:
        """What the arm reports at this step; the controller sees it from the next one on."""
        state = self.safe.take_state(self.driver.state)
        if state is None:
            if not self.safe.alarm:
                raise RuntimeError(f"{self.plan.arm}: a state that cannot be: {self.safe.bad_state}")
            self._abort(self.safe.alarm)
            return
        pose = StampedPose(state.stamp_ns, state.T_base_controlled)
        self.inputs = replace(self.inputs, sensor_pose=pose)
        self.log.state(state)
        if state.mode is ArmMode.FAULT:
            self._abort(state.reason)

    def _abort(self, reason: str) -> None:
        if self.task is not None:
            self.task.abort(f"the arm is in fault: {reason}")

    def control(self, now_ns: int) -> Command | None:
        """Steps of the task for what has become due, or for the time that has passed; the last command."""
        command, due = None, self._due(now_ns)
        for event in due:
            if event.belief is not None or not event.presence.in_contact:
                self.safe.take_contact(event.presence.stamp_ns, event.belief.T if event.belief else None)
            if event.force is not None:
                self.safe.take_force(event.force.stamp_ns, event.force.force)
            belief, force = event.belief or self.inputs.belief, event.force or self.inputs.force
            self.inputs = TaskInputs(belief, event.presence, self.inputs.sensor_pose, force=force)
            command = self._step(event.due_ns)
            if command is not None:
                self.log.latency(event.presence.stamp_ns, event.due_ns)
        if not due and now_ns - self.stepped_ns >= self.options.control_period * SECOND_NS:
            command = self._step(now_ns)
        return command

    def _step(self, now_ns: int) -> Command | None:
        self.stepped_ns = now_ns
        if self.task is None:
            return None
        self.task.remark = self.remark
        self.task.partner = self.partners.trouble(now_ns * NANOSECOND)
        self.task.partner_hold = self.partners.hold
        command = task_step(self.task, now_ns, self.inputs)
        self.traceback = self.traceback or self.task.traceback
        self.safe.command(now_ns, command.twist, self.plan.role.name)
        self.log.command(now_ns, self.goal, command)
        self.log.ahead(now_ns, self.task.ahead)
        return command

    def expose(self) -> None:
        """One exposure through perception and filter, as the nodes do it, if it is time for one."""
        if self.perceive is None or not self.cell.exposure_due(self.plan.arm):
            return
        frame = self.cell.expose(self.plan.arm)
        percept = self._percept(frame)
        self.log.exposure(frame)
        if self.loose:
            self.log.body(frame.stamp_ns, self.cell.T_world_body(self.loose))
        if percept is None:  # as if there had been no exposure
            return
        self.log.percept(frame.stamp_ns, percept)
        if percept.in_contact is None:
            if percept.fault:
                self._refuse(
                    "references refused", f"reference of the contact presence refused: {percept.fault}"
                )
            return
        self.remark = ""
        estimate = percept.estimate if percept.in_contact else None
        if percept.in_contact and estimate is None:  # a network that failed: nothing is known of this contact
            if percept.fault:
                self._refuse("estimates refused", f"estimate refused: {percept.fault}")
            self._send(StampedPresence(frame.stamp_ns, True, percept.still), None)
            return
        belief = self.filter.observe(frame.stamp_ns, estimate, frame.T_base_sensor)
        if belief.valid:
            self.log.belief(belief)
        pose = StampedPose(frame.stamp_ns, belief.mean) if belief.measured else None
        presence = StampedPresence(frame.stamp_ns, percept.in_contact, percept.still)
        self._send(presence, pose, self._force(frame.stamp_ns, percept))

    def _percept(self, frame: Frame) -> Percept | None:
        """What perception makes of a frame, as far as nothing lies; None of an image that it refuses."""
        assert self.perceive is not None
        name, stamp_ns = frame.arm, frame.stamp_ns
        if frame.image is not None:
            frame = replace(frame, image=self.lies.image(name, stamp_ns, frame.image))
        try:
            percept = self.perceive(frame)
        except ImageError as error:
            self._refuse("images refused", f"tactile/image refused: {error}")
            return None
        told = replace(percept, estimate=self.lies.estimate(name, stamp_ns, percept.estimate))
        return self.agreement(told, DEPTH_DIFFERENCE)

    def _force(self, stamp_ns: int, percept: Percept) -> StampedForce | None:
        """What is believed of the force, as the filter node does it; None where nothing is told of it."""
        if not percept.in_contact:
            self.forces.reset()
        if percept.force is None or self.forces.step(stamp_ns, percept.force):
            return None
        assert self.forces.belief is not None
        self.log.force(stamp_ns, percept.force, self.forces.belief, self.forces.nis)
        return StampedForce(stamp_ns, self.forces.belief.mean)

    def _refuse(self, counter: str, text: str) -> None:
        """Count what the estimator node would count, and tell the task."""
        self.refused[counter] += 1
        self.remark = text

    def _due(self, now_ns: int) -> list[_Event]:
        due = []
        while self.queue and self.queue[0].due_ns <= now_ns:
            due.append(self.queue.popleft())
        return due

    def _send(
        self, presence: StampedPresence, belief: StampedPose | None, force: StampedForce | None = None
    ) -> None:
        latency = self.options.latency
        if self.options.jitter > 0.0:
            latency += self.options.jitter * float(self.random.random())
        due_ns = self.cell.stamp_ns + round(latency * SECOND_NS)
        if self.queue:
            due_ns = max(due_ns, self.queue[-1].due_ns)  # a chain of nodes keeps the order
        self.queue.append(_Event(due_ns, presence, belief, force))
