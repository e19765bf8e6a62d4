"""A node that stands in for a whole cell: an arm that moves while a goal runs, and faults that tests want.

The parameter `fault` is one of: "", "configure", "die", "fail", "deaf", "never_active", "ends_badly",
"estop", "estop_and_on" (it moves on all the same).
"""

import os
import signal
import sys
import time
from pathlib import Path

from rclpy.action import ActionServer, CancelResponse
from std_msgs.msg import Bool

from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmStatus
from tactile_ros.managed_node import ConfigurationError, ManagedNode
from tactile_ros.parameters import declare_read_only
from tactile_ros.qos import STATE
from tactile_ros.run_nodes import run
from tactile_ros.task_node import conclude

ENDS = {signal.SIGINT, signal.SIGTERM}


class FakeCell(ManagedNode):
    def __init__(self):
        super().__init__("fake_cell")
        self.fault = declare_read_only(self, "fault", "", "how to misbehave")
        self.seconds = declare_read_only(self, "seconds", 0.5, "duration of a goal")
        self.goal = None
        self.stopped_at = None
        runaway = "THE ARM DOES NOT STOP, press the emergency stop that is wired to it: "
        self.why = runaway * (self.fault == "estop_and_on") + "emergency stop: button"

    def configure(self):
        if self.fault == "configure":
            raise ConfigurationError("the model file is missing: /no/such/model.onnx")
        self.status_out = self.publisher(ArmStatus, "arm/status", STATE)
        self.subscribe(Bool, "/estop", self.on_estop, STATE, always=True)
        self.timer(0.02, self.tick)
        server = ActionServer(
            self, RunTask, "run_task", lambda handle: None, cancel_callback=self.cancel,
            handle_accepted_callback=self.accept,
        )  # fmt: skip
        self.release_later(ActionServer.destroy, server)

    def accept(self, handle):
        self.goal, self.started = handle, time.monotonic()

    def cancel(self, handle):
        self.get_logger().info("cancel requested")
        self.finish_at = time.monotonic() + 0.2  # an arm takes a while to come to rest
        self.started = self.finish_at - self.seconds
        return CancelResponse.ACCEPT

    def on_estop(self, message):
        if self.goal is not None:
            self.stopped_at = time.monotonic()
            self.end("emergency stop")

    def tick(self):
        self.status_out.publish(self.status())
        if self.goal is None:
            return
        elapsed = time.monotonic() - self.started
        if self.fault.startswith("estop") and elapsed > 0.2:
            self.stopped_at = time.monotonic()
            self.end("emergency stop")
            return
        if self.fault == "die" and elapsed > 0.2:
            print("FATAL: the gel is torn", flush=True)
            os._exit(7)
        feedback = RunTask.Feedback(phase="follow", progress=elapsed / self.seconds, depth=0.003)
        self.goal.publish_feedback(feedback)
        if elapsed >= self.seconds:
            self.end()

    def status(self):
        if self.stopped_at is None:
            return ArmStatus(mode=ArmStatus.MOVING if self.goal else ArmStatus.RESTING)
        brakes = time.monotonic() - self.stopped_at < 0.1 or self.fault == "estop_and_on"
        twist = [0.01 * brakes] + [0.0] * 5
        return ArmStatus(mode=ArmStatus.ESTOP, reason=self.why, twist=twist)

    def end(self, failure=""):
        handle, self.goal = self.goal, None
        cancelled = handle.is_cancel_requested
        success = not (cancelled or failure or self.fault == "fail")
        reason = "" if success else "cancelled" if cancelled else failure or "lost the contact at 12 mm"
        conclude(handle, RunTask.Result(success=success, reason=reason, path_length=0.05))


def main():
    given = Path(sys.argv[-1]).read_text()
    if "fault: deaf" in given and not signal.pthread_sigmask(signal.SIG_BLOCK, ENDS):
        os.execv(sys.executable, sys.orig_argv)  # once more, so that threads of libraries have the mask, too
    if "fault: never_active" in given:
        time.sleep(60)
    return run(FakeCell) or 9 * ("fault: ends_badly" in given)


if __name__ == "__main__":
    sys.exit(main())
