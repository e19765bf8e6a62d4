"""ManagedNode: a lifecycle node that starts by itself, reports on itself and ends cleanly.

A node derives from it, fills in `configure`, `activate`, `deactivate` and `cleanup`, and ends with::

    def main() -> int:
        return run(EstimatorNode)

With the parameter `autostart` (the default) it configures and activates itself; if that fails, the process
ends with exit code 1 and says why. Without, it waits unconfigured for a lifecycle manager and survives a
failure. SIGINT and SIGTERM end it in order (`run_nodes`): it goes on while it is needed, then is
deactivated and cleaned up, and the process ends with exit code 0.
"""

from __future__ import annotations

import math
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.timer import Timer

from tactile_base import topics
from tactile_base.raised import told
from tactile_base.settings import SettingError, Settings, setting, unknown_name
from tactile_base.stamps import NANOSECOND
from tactile_filter.events import FUTURE_NS
from tactile_ros.commander import Commander
from tactile_ros.diagnostics import Diagnostics, InputWatch
from tactile_ros.message_bytes import header_of
from tactile_ros.parameters import (
    SettingsParameters,
    declare_read_only,
    fixed_settings,
    meant,
    refusing_unknown_types,
)
from tactile_ros.qos import DIAGNOSTICS, writer_profile
from tactile_ros.scheduling import freeze_gc
from tactile_wire.errors import MessageError
from tactile_wire.packing import LONGEST_SAID

Result = TransitionCallbackReturn

COMMON_PARAMETERS = ("use_sim_time", "start_type_description_service")
NEWS_PERIOD = 0.2  # s, within which others, as a task that fails for it, know what is wrong
CONTROLLED_FRAMES = ("tactile_sensor", "tool")  # what an arm with a sensor, and one without, is controlled by
LARGEST_PRIORITY = 99  # of SCHED_FIFO
LARGEST = 1 << 18  # bytes of a raw message that is no image; one that is read takes no more than 0.1 s then
TOO_FAST = "messages came too fast"


@dataclass(frozen=True)
class StampSettings(Settings):
    """Which stamps are believed."""

    future_tolerance: float = setting(
        FUTURE_NS * NANOSECOND, lower=0.001, upper=10.0, unit="s",
        doc="a message or transform stamped further ahead of the clock is refused; with use_sim_time to "
        "be more than a period of /clock",
    )  # fmt: skip


@dataclass(frozen=True)
class FrameSettings(Settings):
    """How the frames of the arm are called; those that are not said are `<arm>/<name>`."""

    base: str = setting("", doc="where the arm stands; empty: <arm>/base")
    tool: str = setting("", doc="the arm's flange; empty: <arm>/tool")
    sensor: str = setting("", doc="the tactile sensor; empty: <arm>/tactile_sensor")
    contact: str = setting("", doc="what it touches, by the belief; empty: <arm>/contact")


class ConfigurationError(RuntimeError):
    """What keeps a node from being configured or activated, in words for its user."""


class ManagedNode(LifecycleNode):
    """Base of all nodes; see the module's docstring.

    Attributes
    ----------
    patience : float
        Seconds for which a node that was asked to end goes on at most; shorter where it commands an arm.
    """

    patience: ClassVar[float] = 6.0

    def __init__(self, name: str, **kwargs: Any) -> None:
        super().__init__(name, **kwargs)
        self.autostart = declare_read_only(self, "autostart", True, "configure and activate when started")
        namespace = self.get_namespace().strip("/")
        named = namespace.rsplit("/", 1)[-1] or "arm"
        self.arm = declare_read_only(self, "arm", named, "name of the arm, first part of its frames' names")
        self.priority = declare_read_only(
            self, "priority", 0, "SCHED_FIFO priority 1..99 of the process, and locked memory; 0: neither"
        )
        if not 0 <= self.priority <= LARGEST_PRIORITY:
            raise SettingError(f"parameter priority = {self.priority}: must lie in [0, {LARGEST_PRIORITY}]")
        self.cores: list[int] = declare_read_only(
            self, "cores", [-1], "numbers of the cores that the process runs on; -1: any"
        )
        frames = fixed_settings(self, FrameSettings(), "frames")
        self.base_frame = frames.base or topics.base_frame(self.arm)
        self.tool_frame = frames.tool or topics.tool_frame(self.arm)
        self.sensor_frame = frames.sensor or topics.sensor_frame(self.arm)
        self.contact_frame = frames.contact or topics.contact_frame(self.arm)
        self.active = False
        self.stop_reason = ""
        self.exit_code = 0
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.report = Diagnostics(self.get_fully_qualified_name(), self.arm)
        self.counters = self.report.counters
        self._last_warning: dict[str, float] = {}
        self._while_configured: list[tuple[Callable[[Any], Any], Any]] = []
        self._commanders: list[Commander] = []
        self._diagnostics = self.create_publisher(
            DiagnosticArray, topics.DIAGNOSTICS.name, writer_profile(DIAGNOSTICS)
        )
        self.stamps = SettingsParameters(self, StampSettings(), prefix="stamps")
        about = "seconds between two reports on /diagnostics"
        period = declare_read_only(self, "diagnostics_period", 1.0, about)
        self._diagnostics_timer = self.create_timer(period, self.publish_diagnostics, clock=self.steady)
        self._news_timer = self.create_timer(NEWS_PERIOD, self._report_news, clock=self.steady)

    # What a node fills in. Each may raise ConfigurationError or SettingError to refuse.

    def configure(self) -> None:
        """Load what is needed and create publishers and subscriptions."""

    def activate(self) -> None:
        """Start from a clean state; messages are processed from now on."""

    def deactivate(self) -> None:
        """Bring to rest what is moving; messages are ignored from now on."""

    def cleanup(self) -> None:
        """Release what `configure` has loaded; publishers, subscriptions and timers go without it."""

    def command_topics(self) -> list[str]:
        """Full names of the topics by which the arms are commanded that this node works for."""
        return [self.resolve_topic_name(topics.COMMAND.name)]

    def prepare_to_end(self, reason: str) -> None:
        """A signal has come: the node goes on while it is `needed`, and begins what that takes."""
        if self.active:
            self._commanders = [Commander(self, topic) for topic in self.command_topics()]

    def needed(self) -> bool:
        """Whether a node that was asked to end goes on: somebody still moves an arm that it works for."""
        return any(commander.moves for commander in self._commanders)

    @property
    def linger_time(self) -> float:
        """Seconds that what the node has said last still needs to arrive."""
        return 0.0

    def due_in(self) -> float:
        """Seconds until `work` wants to be called, for a node with a time base of its own; inf: never."""
        return math.inf

    def work(self) -> None:
        """What is due; called between callbacks once `due_in` is not positive."""

    # What a node uses.

    def frame_of(self, controlled: str) -> str:
        """The frame of one of `CONTROLLED_FRAMES` of this node's arm."""
        return {"tactile_sensor": self.sensor_frame, "tool": self.tool_frame}[controlled]

    def now_ns(self) -> int:
        """ROS time now, ns."""
        return int(self.get_clock().now().nanoseconds)

    def publisher(self, message_type: type, topic: str, qos: QoSProfile) -> Any:
        """A publisher that exists while the node is configured and publishes while it is active."""
        publisher: Any = self.create_lifecycle_publisher(message_type, topic, writer_profile(qos))
        self._while_configured.append((self.destroy_lifecycle_publisher, publisher))
        return publisher

    def subscribe(
        self,
        message_type: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: QoSProfile,
        age_limit: float | None = None,
        always: bool = False,
        raw: bool = False,
        stamped: bool = False,
        frame: str = "",
        why_lost: Callable[[], str] = lambda: TOO_FAST,
        largest: int = LARGEST,
    ) -> InputWatch | None:
        """Call `callback` with each message while the node is active (or whenever configured, with `always`).

        With an `age_limit` (s) the input's silence is told in /diagnostics; 0 watches without limit.
        With `raw` the callback gets the serialized message; if it raises `MessageError`, because the bytes
        are no such message, that message is refused, as is one of more than the `largest` number of bytes.
        With `stamped`, so is one from the future, and with `frame` one of another frame as well (both of
        `raw` messages that start with a header). What is refused is counted as `refused_counter(topic)` and
        told. Messages that the middleware could not keep for this node, because it was held up, are counted
        as `lost_counter(topic)`, and told with `why_lost`.
        """
        watch = None if age_limit is None else self.report.watch(topic, age_limit)

        def take(message: Any) -> None:
            if raw and len(message) > largest:
                raise MessageError(f"has {len(message)} bytes, must have no more than {largest}")
            if stamped or frame:
                stamp_ns, found = header_of(message)
                self.check_stamp(stamp_ns)
                if frame and found != frame:
                    raise MessageError(f"frame is '{found}', must be '{frame}'")
            callback(message)

        def receive(message: Any) -> None:
            if watch is not None:
                watch.seen()
            if self.active or always:
                try:
                    take(message)
                except MessageError as error:
                    self.count(refused_counter(topic))
                    self.warn(f"{topic} refused", f"{topic} refused: {error}")

        def lose(info: Any) -> None:
            if self.active:
                self.count(lost_counter(topic), info.total_count_change)
                self.warn(f"{topic} lost", f"{topic}: {info.total_count_change} {why_lost()}")

        events = SubscriptionEventCallbacks(message_lost=lose)
        subscription = self.create_subscription(
            message_type, topic, receive, qos, event_callbacks=events, raw=raw
        )
        self._while_configured.append((self.destroy_subscription, subscription))
        return watch

    def check_stamp(self, stamp_ns: int) -> None:
        """Raise `MessageError` for a stamp from the future: until its time has come it would be the newest.

        A clock at 0 is one of `use_sim_time` that has not come yet: nothing can be said.
        """
        now_ns = self.now_ns()
        tolerance = self.stamps.value.future_tolerance
        if now_ns and (stamp_ns - now_ns) * NANOSECOND > tolerance:
            ahead = (stamp_ns - now_ns) * NANOSECOND
            raise MessageError(f"its stamp is {ahead:.3f} s ahead of the clock (limit {tolerance:g} s)")

    def timer(self, period: float, callback: Callable[[], None]) -> Timer:
        """Call `callback` every `period` seconds of the steady clock while the node is active."""
        timer = self.create_timer(period, lambda: callback() if self.active else None, clock=self.steady)
        self._while_configured.append((self.destroy_timer, timer))
        return timer

    def create_service(self, srv_type: Any, srv_name: str, callback: Any, **kwargs: Any) -> Any:
        """As rclpy's; a parameter of a type that does not exist is refused, where rclpy's own would raise."""
        if srv_type in (SetParameters, SetParametersAtomically):
            callback = refusing_unknown_types(callback)
        return super().create_service(srv_type, srv_name, callback, **kwargs)

    def set_parameters_atomically(self, parameter_list: list[Parameter[Any]]) -> SetParametersResult:
        """As rclpy's, for values as tools mean them (`parameters.meant`)."""
        given = meant(self, parameter_list)
        return super().set_parameters_atomically(given) if given else SetParametersResult(successful=True)

    def serve(self, service_type: type, name: str, callback: Callable[[Any, Any], Any]) -> None:
        """Offer a service while the node is configured."""
        service = self.create_service(service_type, name, callback)
        self._while_configured.append((self.destroy_service, service))

    def serve_request(
        self, service_type: type, name: str, act: Callable[[Any], None], success_message: str
    ) -> None:
        """Offer a service that acts while the node is active, and answers with the message then."""

        def answer(request: Any, response: Any) -> Any:
            response.success = self.active
            response.message = success_message if self.active else "the node is not active"
            if self.active:
                act(request)
            return response

        self.serve(service_type, name, answer)

    def release_later(self, destroy: Callable[[Any], Any], thing: Any) -> None:
        """Have `destroy(thing)` called at clean-up."""
        self._while_configured.append((destroy, thing))

    def warn(self, key: str, message: str, period: float = 1.0) -> None:
        """Tell a warning in /diagnostics, and log it at most once a `period` (s) for each `key`."""
        message = message[:LONGEST_SAID]  # it may quote what a stranger sent
        self.report.complain(key, message)
        self._log_warning(key, message, period)

    def _log_warning(self, key: str, message: str, period: float) -> None:
        now = time.monotonic()
        if now - self._last_warning.get(key, -period) >= period:
            self._last_warning[key] = now
            self.get_logger().warning(message)

    def warn_of_unknown_parameters(self) -> None:
        """Tell values that were given at start for parameters that this node does not have: typos, mostly."""
        known = list(self._parameters)
        for name in self._parameter_overrides:
            if name not in known and name not in COMMON_PARAMETERS and not name.startswith("qos_overrides."):
                self.get_logger().warning(f"parameter ignored: {unknown_name(name, known)}")

    def count(self, what: str, number: int = 1) -> None:
        """Count something that /diagnostics shows."""
        self.counters[what] += number

    def stop(self, reason: str, exit_code: int = 0) -> None:
        """Have the process end after this callback."""
        self.stop_reason, self.exit_code = reason, exit_code

    def _report_news(self) -> None:
        if self.report.has_news(self.active):
            self.publish_diagnostics()

    def publish_diagnostics(self) -> None:
        """Report now; also called once a second."""
        state = self._state_machine.current_state[1]
        if self.active:
            for complaint in self.report.silent_inputs():
                self._log_warning(complaint.split(":")[0], complaint, period=5.0)
        if self.get_node_names_and_namespaces().count((self.get_name(), self.get_namespace())) > 1:
            name = self.get_fully_qualified_name()
            self.warn("twin", f"another node in this ROS domain is called {name}, too: end one of them", 5.0)
        self._diagnostics.publish(self.report.message(self.get_clock().now().to_msg(), state, self.active))

    # Lifecycle transitions.

    def on_configure(self, state: LifecycleState) -> Result:
        """Configure; whatever a refused configuration had created is released again."""
        self.report.fault = ""
        self.report.inputs.clear()
        result = self._attempt("configure", self.configure)
        if result != Result.SUCCESS:
            self._release()
            self._attempt("clean up", self.cleanup)
            return result
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> Result:
        """Activate; from here on messages are processed."""
        super().on_activate(state)
        self.counters.clear()
        result = self._attempt("activate", self.activate)
        if result != Result.SUCCESS:
            super().on_deactivate(state)
            return result
        for watch in self.report.inputs.values():
            watch.restart()
        self.active = True
        freeze_gc()
        self.get_logger().info("active")
        return Result.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> Result:
        """Deactivate: the node's own part first, while it can still publish."""
        result = self._attempt("deactivate", self.deactivate)
        self.active = False
        super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> Result:
        """Release everything that configuring had created."""
        result = self._attempt("clean up", self.cleanup)
        self._release()
        return result

    def on_shutdown(self, state: LifecycleState) -> Result:
        """From any state: deactivate and clean up as far as needed."""
        if self.active:
            self.on_deactivate(state)
        return self.on_cleanup(state)

    def on_error(self, state: LifecycleState) -> Result:
        """After an error in a transition: release everything and be unconfigured again."""
        self.active = False
        self._release()
        return Result.SUCCESS

    def start(self) -> bool:
        """Configure and activate; False if either was refused, with the reason in `report.fault`."""
        return self.trigger_configure() == Result.SUCCESS and self.trigger_activate() == Result.SUCCESS

    def rest(self) -> None:
        """Deactivate if active, so that nothing keeps moving."""
        if self.active and self.trigger_deactivate() != Result.SUCCESS:
            self.exit_code = self.exit_code or 1

    def finish(self) -> None:
        """Shut down from whatever state this is."""
        living = self._state_machine.current_state[1] in ("unconfigured", "inactive", "active")
        if living and self.trigger_shutdown() != Result.SUCCESS:
            self.exit_code = self.exit_code or 1

    def _attempt(self, what: str, action: Callable[[], None]) -> Result:
        try:
            action()
        except (ConfigurationError, SettingError) as error:
            self.report.fault = f"cannot {what}: {error}"
            self.get_logger().error(self.report.fault)
            return Result.FAILURE
        except Exception as error:
            self.report.fault = f"cannot {what}: {told(error)}"
            self.get_logger().error(f"{self.report.fault}\n{traceback.format_exc()}")
            return Result.ERROR
        return Result.SUCCESS

    def _release(self) -> None:
        while self._while_configured:
            destroy, thing = self._while_configured.pop()
            destroy(thing)


def refused_counter(topic: str) -> str:
    """Name of the counter of messages on `topic` that are none, or of another time or frame."""
    return f"{topic} messages refused"


def lost_counter(topic: str) -> str:
    """Name of the counter of messages on `topic` that the middleware has lost on their way to a node."""
    return f"{topic} messages lost"
