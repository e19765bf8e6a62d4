"""Arm node: one arm of a scene on ROS, whoever drives it, behind the safe command stage.

Publishes /tf from base to tool at every state of the driver, `arm/pose`, `arm/status`,
`command/twist_limited`, and where joints are known `joint_states` (`tactile_ros.joint_states`); listens to
`command/request`, in the arm's controlled frame, to `contact/state`, which bounds the motion, and to
`/estop`; `arm/estop` and `arm/reset` are its services, and `tactile stop` reaches it without ROS
(`tactile_base.stop_line`). What is refused, and what is followed, `SafeArm` decides.

A driver of the registry `ARMS` is opened here, in a process of its own; so is the one that speaks to the
nodes of an external arm. A simulated arm is given by the process of the simulated cell, which runs this node
beside its own (`attach`) and publishes /tf of all its arms in one message: that every node takes every
message of /tf is most of what a second arm costs them.

The arm is stopped when commands stop coming, when the driver reports no state any more, and when the node is
deactivated.
"""

from __future__ import annotations

import sys
import threading
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped, TwistStamped
from rclpy.task import Future
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from tactile_base import topics
from tactile_base.raised import defined_in
from tactile_base.settings import Settings, setting
from tactile_base.stamps import SECOND_NS
from tactile_base.stop_line import StopLine, arms_here
from tactile_doubles.rehearsal import DOUBLES, rehearsed
from tactile_drivers.arm_distance import Neighbour, neighbours, watched_arms
from tactile_drivers.motion_bounds import bounds_in_words
from tactile_drivers.safety import SafeArm
from tactile_filter.contact_bounds import ContactBounds
from tactile_geometry import se3
from tactile_msgs.msg import ArmCommand, ArmStatus, ContactForce, ContactState
from tactile_records.messages import arm_status_bytes, pose_bytes
from tactile_ros.conversions import header, transform_stamped
from tactile_ros.external_arm import ExternalArm, external_settings
from tactile_ros.joint_states import JointListener, JointPublisher
from tactile_ros.joint_velocity_arm import JointVelocityArm
from tactile_ros.managed_node import ConfigurationError, ManagedNode
from tactile_ros.message_bytes import (
    STATE_FLAGS,
    STATE_XI,
    Layout,
    command_from_bytes,
    force_from_bytes,
    read_state,
    twist_bytes,
)
from tactile_ros.parameters import SettingsParameters, fixed_settings
from tactile_ros.qos import COMMAND, STATE, TF, TF_STATIC
from tactile_ros.run_nodes import run
from tactile_scene.arm import ARMS, Arm, ArmMode, ArmState, is_at_rest, open_arm
from tactile_scene.external_settings import ExternalArmSettings
from tactile_scene.scene import EXTERNAL, SIM, ArmScene, Scene
from tactile_scene.scene_file import load_scene
from tactile_wire.errors import MessageError
from tactile_wire.packing import split_stamp
from tactile_wire.pose_numbers import numbers_from_pose

DOUBLE_STARTS = 30.0  # s, at most, for the simulated cell to start the double of an arm


@dataclass(frozen=True)
class ArmNodeSettings(Settings):
    """Which scene the arm stands in, and what is told of it."""

    scene: str = setting("", doc="scene: the name of a packaged one, or the path of a .yaml file")
    status_rate: float = setting(
        30.0, lower=1.0, upper=1000.0, unit="Hz", doc="rate of arm/pose, arm/status and command/twist_limited"
    )
    rehearse: bool = setting(
        False, doc="drive the double of the arm, which the simulated cell has, not the arm"
    )
    state_timeout: float = setting(
        0.1, lower=0.01, upper=10.0, unit="s", doc="silence of the driver at which the arm is stopped"
    )
    feels: bool = setting(
        True,
        doc="whether a filter tells what the arm's sensor feels, without which the arm crawls; false where "
        "there is none yet, as in data collection: then the workspace alone bounds how deep it goes",
    )


def arm_of_scene(node: ManagedNode, scene: str, rehearse: bool = False) -> tuple[ArmScene, Scene]:
    """The node's arm in a scene, and the scene; raises `ConfigurationError` if it is not there."""
    loaded = rehearsed(load_scene(scene)) if rehearse else load_scene(scene)
    if node.arm not in loaded.arms:
        raise ConfigurationError(f"{loaded.path}: no arm '{node.arm}'; arms: {', '.join(loaded.arms)}")
    return loaded.arms[node.arm], loaded


class ArmNode(ManagedNode):
    """See the module's text; `hosted` is the arm's scene where another node of the process drives it."""

    def __init__(self, hosted: ArmScene | None = None, **kwargs: Any) -> None:
        super().__init__("arm", **kwargs)
        fixed = ("scene", "status_rate", "rehearse", "feels")
        self.settings = SettingsParameters(self, ArmNodeSettings(), read_only=fixed)
        self.bounds = fixed_settings(self, ContactBounds(), "bounds")
        self.hosted, self.whose = hosted, ""
        self.estop = ""  # why; it outlives a deactivation

    # ---- lifecycle ----

    def configure(self) -> None:
        """Open topics and, unless another node does, the driver."""
        scene, cell = (self.hosted, None) if self.hosted is not None else self._scene()
        self.scene = scene
        self.states = self.report.watch("states of the driver", self.settings.value.state_timeout)
        self.safe = SafeArm(scene, self.now_ns, self.settings.value.feels)
        self.safe.neighbours = self._neighbours(cell) if cell is not None else ()
        self.frame = self.frame_of(scene.controlled_frame)
        self.limits = scene.limits
        self.report.values |= bounds_in_words(scene, self.settings.value.feels)
        self.T_controlled_tool = se3.inverse(scene.T_tool_controlled)
        mount = transform_stamped(0, self.tool_frame, self.frame, scene.T_tool_controlled)
        stand = transform_stamped(0, topics.WORLD, self.base_frame, scene.T_world_base)
        theirs = external_settings(scene) if scene.driver == EXTERNAL else None
        self.tells_tool = theirs is None or theirs.publish_tool
        self.static = [stand] if theirs is None else []
        if scene.sensor is not None and (theirs is None or theirs.publish_mount):
            self.static.append(mount)
        chain = scene.kinematics if theirs is None or self._tells_joints(theirs) else None
        self.joints = JointPublisher(self, chain) if chain is not None else None
        self.static += self.joints.static if self.joints is not None else []
        self.tf_static_out = self.publisher(TFMessage, topics.TF_STATIC.name, TF_STATIC)
        self.pose_out = self.publisher(PoseStamped, topics.ARM_POSE.name, STATE)
        self.status_out = self.publisher(ArmStatus, topics.ARM_STATUS.name, STATE)
        self.limited_out = self.publisher(TwistStamped, topics.LIMITED_COMMAND.name, STATE)
        self.subscribe(ArmCommand, topics.COMMAND.name, self._receive, COMMAND, 0.0, raw=True)
        self.subscribe(Bool, topics.ESTOP.name, self._on_estop, STATE, always=True)
        self.serve(Trigger, "arm/estop", self._serve_estop)
        self.serve(Trigger, "arm/reset", self._serve_reset)
        if scene.sensor is not None:
            take = self._take_contact
            self.subscribe(ContactState, topics.STATE.name, take, STATE, raw=True, frame=self.frame)
            if scene.sensor.settings.protective_force:
                force, take = topics.FORCE_BELIEF.name, self._take_force
                self.subscribe(ContactForce, force, take, STATE, raw=True, frame=self.frame)
        self._forget()
        self._open_stop_line()
        if cell is not None:
            self.tf_out = self.publisher(TFMessage, topics.TF.name, TF)
            self.tf_layout = Layout(TFMessage(transforms=[self.moving_transform()]))
            self.timer(scene.limits.command_timeout / 4, self._watch)
            self.safe.attach_driver(self._open(scene))
        else:  # a simulated arm watches its commands itself, and every timer costs the cell time
            self.timer(self.settings.value.state_timeout / 2, self._watch)

    def _tells_joints(self, theirs: ExternalArmSettings) -> bool:
        """Whether an external arm's joints are told here, too: not where its own nodes tell them."""
        own, given = map(self.resolve_topic_name, (topics.JOINT_STATES.name, theirs.joint_states))
        return bool(theirs.joint_velocities) and own != given

    def activate(self) -> None:
        """Tell what never moves; commands are followed from now on."""
        self._forget()
        if self.static:
            self.tf_static_out.publish(TFMessage(transforms=self.static))

    def deactivate(self) -> None:
        """Bring the arm to rest."""
        self.safe.halt("the arm's node was deactivated")

    def cleanup(self) -> None:
        """Let go of an arm that was opened here."""
        if self.hosted is None and hasattr(self, "safe"):
            self.safe.close()

    def attach(self, driver: Arm) -> None:
        """Drive this arm from now on; whoever gives it has its states `checked` and published."""
        self.safe.attach_driver(driver)
        self._forget()

    def _open(self, scene: ArmScene) -> Arm:
        """The driver that the scene names."""
        if scene.driver != EXTERNAL:
            self.whose = f" (arm driver '{scene.driver}', {defined_in(ARMS.load(scene.driver))})"
        try:
            if scene.driver == EXTERNAL:
                moves_joints = external_settings(scene).joint_velocities
                return (JointVelocityArm if moves_joints else ExternalArm)(self, scene, self.take_state)
            return open_arm(scene, self.take_state)
        except (OSError, RuntimeError) as error:
            raise ConfigurationError(f"arm driver '{scene.driver}': {error}") from error

    def _neighbours(self, cell: Scene) -> tuple[Neighbour, ...]:
        """The other arms of the scene, as far as joints are known; their nodes stand beside this one."""
        beside = self.get_namespace().rpartition("/")[0]
        listeners: dict[str, JointListener] = {}
        for name in watched_arms(cell, self.arm):
            chain = cell.arms[name].kinematics
            assert chain is not None
            topic = f"{beside}/{name}/{topics.JOINT_STATES.name}"
            listeners[name] = JointListener(self, topic, chain.names)
        return neighbours(cell, self.arm, lambda name: listeners[name].state, listeners)

    def _scene(self) -> tuple[ArmScene, Scene]:
        """The arm in the scene, which needs a driver of the registry, and the scene."""
        settings = self.settings.value
        arm, cell = arm_of_scene(self, settings.scene, settings.rehearse)
        if settings.rehearse:
            DOUBLES.load(arm.driver).wait(arm, DOUBLE_STARTS)
        if arm.driver == SIM:
            whose = f"arm '{arm.name}' is moved by the simulated cell (sim_node)"
            raise ConfigurationError(f"{cell.path}: {whose}")
        return arm, cell

    def _forget(self) -> None:
        self._state: ArmState | None = None
        self._status_due_ns = 0
        self._commanded_at: float | None = None  # on the steady clock
        self._refused = self._owner = self._alarm = ""
        if self.estop:
            self.safe.estop(self.estop)

    # ---- what the arm says ----

    def take_state(self, state: ArmState) -> None:
        """Publish a state of the driver, which may call this from its own thread."""
        complete = self.checked(state)
        if complete is None:
            return
        if self.active and self.tells_tool:
            self.tf_out.publish(self.tf_layout.pack(*self.transform_numbers(complete)))
        self.publish_status(complete)

    def checked(self, state: ArmState) -> ArmState | None:
        """The state as the safe command stage completes it; None, told and counted, if it cannot be true."""
        complete = self.safe.take_state(state)
        self._tell_alarm()
        if complete is None:
            self.count("states refused")
            self.warn("state", f"{self.arm}: state of the arm refused: {self.safe.bad_state}{self.whose}")
            if self._state is None or self.safe.alarm:
                self._tell_unbelieved()
        elif self.safe.neighbours and state.joints is None:
            others = ", ".join(neighbour.name for neighbour in self.safe.neighbours)
            self.warn("joints", f"the driver tells no joints: no distance is kept from {others}", period=60.0)
        return complete

    def _tell_alarm(self) -> None:
        """Report, as an error until a reset, that the stage has stopped an arm that disobeys."""
        alarm = self.safe.alarm
        if alarm == self._alarm:
            return
        self._alarm, self.report.fault = alarm, f"{self.arm}: {alarm}" if alarm else ""
        if alarm:
            self.get_logger().fatal(f"{self.arm}: {alarm}; arm/reset leaves it")

    def _tell_unbelieved(self) -> None:
        """To those who wait for a state, that those which came cannot be true."""
        now_ns = self.now_ns()
        if not self.active or now_ns < self._status_due_ns:
            return
        self._status_due_ns = now_ns + int(SECOND_NS / self.settings.value.status_rate)
        status = ArmStatus(header=header(now_ns, self.base_frame), mode=ArmStatus.FAULT, command_age=-1.0)
        status.twist = np.full(6, np.nan)  # nobody knows whether it rests
        unbelieved = f"what it says of itself is not believed: {self.safe.bad_state}{self.whose}"
        status.reason = self.safe.alarm or unbelieved
        self.status_out.publish(status)

    def moving_transform(self) -> TransformStamped:
        """An example of what /tf says of the arm; `transform_numbers` are its numbers."""
        return transform_stamped(0, self.base_frame, self.tool_frame, np.eye(4))

    def transform_numbers(self, state: ArmState) -> tuple[float, ...]:
        """Stamp and pose of the tool in the base, which all else waits for."""
        T_base_tool = state.T_base_controlled @ self.T_controlled_tool
        return *split_stamp(state.stamp_ns), *numbers_from_pose(T_base_tool).tolist()

    def publish_status(self, state: ArmState) -> None:
        """Where the controlled frame is, what the arm does and the twist that it makes, if that is due."""
        self.states.seen()
        last, self._state = self._state, state
        first = last is None or state.stamp_ns < last.stamp_ns or state.mode is not last.mode
        if not self.active or (state.stamp_ns < self._status_due_ns and not first):
            return
        period_ns = int(SECOND_NS / self.settings.value.status_rate)
        due_ns = self._status_due_ns + period_ns
        self._status_due_ns = due_ns if due_ns > state.stamp_ns and not first else state.stamp_ns + period_ns
        if state.mode in (ArmMode.FAULT, ArmMode.ESTOP):
            self.report.complain("fault", f"{self.arm}: {state.mode.name.lower()}: {state.reason}")
        if state.remark:
            self.warn("remark", f"{self.arm}: {state.remark}", period=5.0)
        self.pose_out.publish(pose_bytes(state, self.base_frame))
        self.limited_out.publish(twist_bytes(state.stamp_ns, self.frame, state.twist))
        if self.joints is not None:
            self.joints.publish(state)
        self.status_out.publish(arm_status_bytes(state, self.base_frame))

    # ---- commands ----

    def _receive(self, data: bytes) -> None:
        """Hand a command to the safe command stage; refused ones are counted and told."""
        command = command_from_bytes(data)
        source, refusal = command.source, self._silence()
        if command.frame_id != self.frame:  # in another frame it would move the arm wrongly
            refusal = f"frame is '{command.frame_id}', must be '{self.frame}'"
        self._refused = refusal or self.safe.command(
            command.stamp_ns, command.twist, source, command.session, command.sequence
        )
        if self._refused:
            self.count("commands refused")
            self.warn("command", f"{self.arm}: command of {source or 'nobody'} refused: {self._refused}")
            return
        self._commanded_at = time.monotonic()
        if self.safe.owner != self._owner:
            before = f", before by {self._owner}" if self._owner else ""
            self.get_logger().info(f"{self.arm}: commanded by {self.safe.owner or 'nobody by name'}{before}")
            self._owner = self.safe.owner

    def _take_contact(self, data: bytes) -> None:
        """What the sensor feels bounds the motion."""
        stamp_ns, _, numbers = read_state(data)
        flags = int(numbers[STATE_FLAGS])
        if flags & ContactState.NO_CONTACT:
            self.safe.take_contact(stamp_ns, None)
        elif not flags & ContactState.INVALID:
            try:
                self.safe.take_contact(stamp_ns, self.bounds.pose(np.array(numbers[STATE_XI])))
            except se3.PoseError as error:
                raise MessageError(str(error)) from error

    def _take_force(self, data: bytes) -> None:
        """And so does how hard it is pressed."""
        self.safe.take_force(*force_from_bytes(data))

    def _on_estop(self, message: Bool) -> None:
        """An emergency stop of all arms; the topic cannot take it back."""
        if message.data:
            self._stop_emergency("asked for on /estop")

    def _stop_emergency(self, reason: str) -> None:
        if not self.estop:
            self.get_logger().error(f"{self.arm}: emergency stop: {reason}; arm/reset leaves it")
        self.estop = self.estop or reason
        self.safe.estop(self.estop)

    def _open_stop_line(self) -> None:
        """Let whoever started this node stop its arm without ROS, and refuse to be the arm's second node."""
        name, domain = self.get_namespace(), self.context.get_domain_id()
        try:
            twins = [word.pid for word in arms_here(domain) if word.arm == name]
            if twins:
                raise ConfigurationError(
                    f"process {twins[0]} is a node of {name} in ROS domain {domain} already: end it first"
                )
            line = StopLine(name, domain, self._stop_emergency, self._at_rest)
        except OSError as error:
            text = "`tactile stop` reaches this arm by /estop alone, which takes seconds"
            self.get_logger().warning(f"{text}: {error}")
            return
        self.release_later(StopLine.close, line)

    def _at_rest(self) -> tuple[bool, str]:
        """Whether the arm rests in an emergency stop, as far as it is believed, and what it does in words."""
        state, silence = self.safe.state, self._silence()
        if state is None or silence:
            return False, silence or "it has told nothing of itself yet"
        rests = state.mode is ArmMode.ESTOP and is_at_rest(state.twist)
        text = f"{state.mode.name.lower()}: {state.reason}" if state.reason else state.mode.name.lower()
        return rests and not self.safe.alarm, text

    def _serve_estop(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._stop_emergency("asked for by the service arm/estop")
        response.success, response.message = True, "the arm comes to rest, and stays there until arm/reset"
        return response

    async def _serve_reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Leave what stopped the arm; a driver that takes its time for it keeps no stop from being heard."""
        done: Future = Future()
        threading.Thread(target=self._reset, args=(done,), daemon=True).start()
        error = await done
        if error:
            response.success, response.message = False, f"the arm cannot leave its fault: {error}"
            return response
        self.estop = ""
        response.success, response.message = True, "the arm moves again once a command of zero has come"
        return response

    def _reset(self, done: Future) -> None:
        try:
            self.safe.reset()
        except RuntimeError as error:
            done.set_result(str(error) or "it does not say why")
        else:
            done.set_result("")

    def _silence(self) -> str:
        """Why what the driver says cannot be relied on; empty if it can."""
        age, limit = self.states.age, self.settings.value.state_timeout
        if self._state is None or age <= limit:
            return ""
        refused = f"; last refused: {self.safe.bad_state}" if self.safe.bad_state else ""
        return f"no state from the driver for {age:.3f} s (limit {limit:g} s){refused}"

    def _watch(self) -> None:
        """Stop the arm if nobody commands it any more, or its driver says nothing."""
        if self._commanded_at is None:
            return
        silence, age = self._silence(), time.monotonic() - self._commanded_at
        if silence:
            self.safe.halt(silence)
        elif age > self.limits.command_timeout:
            refused = f"; last refused: {self._refused}" if self._refused else ""
            limit = self.limits.command_timeout
            self.safe.stop(f"no command for {age:.3f} s (limit {limit:g} s){refused}")
        else:
            return
        self._commanded_at = None


def main() -> int:
    """Run the node until a signal; returns the exit code."""
    return run(ArmNode)


if __name__ == "__main__":
    sys.exit(main())
