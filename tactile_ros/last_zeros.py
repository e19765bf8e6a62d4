"""LastZeros: a process that sends zeros to a velocity controller when its commander cannot any more.

    last = LastZeros(node, "/forward_velocity_controller/commands", joints=6, silence=0.1)
    last.told(moves=True)               # with every command

The process hears through a pipe whether the arm was told to move. If the pipe ends meanwhile (the node was
killed) or says nothing for longer than commands may be apart (it stands still), zeros go out.
"""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import rclpy
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64MultiArray

from tactile_base.node_topics import LAST_ZEROS
from tactile_ros.discovery import use_dds_profile
from tactile_ros.qos import COMMAND

if TYPE_CHECKING:
    from tactile_ros.managed_node import ManagedNode

ENCLAVE = "--enclave"  # whose keys both processes have, where DDS security is on
MOVES, RESTS = b"m", b"r"
READY = b"+"  # what it says once it has found the controller
LOOKS = 0.05  # s between two looks for it
LATER = 0.1  # s, after commands may be apart no longer, that it waits for the node's own stop
REPEATS, REPEAT = 10, 0.05  # of zeros after the node's end, and s between two
LONGEST_END = 2.0  # s, that it may take to end


class LastZeros:
    """The process, as the node has it.

    Parameters
    ----------
    topic : str
        Full name of the controller's topic.
    joints : int
    silence : float
        By which commands may be apart while the arm moves, s.
    """

    def __init__(self, node: ManagedNode, topic: str, joints: int, silence: float) -> None:
        at = sys.argv.index(ENCLAVE) if ENCLAVE in sys.argv else len(sys.argv)
        ros = ["--ros-args", "-r", f"__ns:={node.get_namespace()}", *sys.argv[at : at + 2]]
        self._command = [sys.executable, "-m", __name__, topic, str(joints), f"{silence + LATER:g}", *ros]
        self._variables = {**os.environ, "ROS_DOMAIN_ID": str(node.context.get_domain_id())}
        self._start()

    def _start(self) -> None:
        # a session of its own: what ends the node's whole group leaves it the time to send zeros
        command, variables, pipe = self._command, self._variables, subprocess.PIPE
        self._process = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, env=variables, start_new_session=True
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        os.set_blocking(self._process.stdin.fileno(), False)
        self._found = False

    @property
    def ready(self) -> bool:
        """Whether it has found the controller, without which it could not stop the arm."""
        said = self._process.stdout
        if not self._found and said is not None and select.select([said], [], [], 0.0)[0]:
            self._found = os.read(said.fileno(), 1) == READY
        return self._found

    @property
    def fault(self) -> str:
        """Why the process is gone; '' while it runs."""
        code = self._process.poll()
        return "" if code is None else f"the process that stops the arm if this one dies has ended ({code})"

    def told(self, moves: bool) -> None:
        """The controller is told to move the arm, or to let it rest."""
        assert self._process.stdin is not None
        # where it stands still, the pipe fills up; that it has ended, `fault` says
        with contextlib.suppress(BlockingIOError, BrokenPipeError):
            os.write(self._process.stdin.fileno(), MOVES if moves else RESTS)

    def restart(self) -> None:
        """Start it again if it has ended."""
        if self.fault:
            self._start()

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.stdout.close()
        try:
            self._process.wait(LONGEST_END)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main() -> int:
    """Watch over the controller of the command line until the pipe ends; returns the exit code."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the node ends it, in its own time
    topic, joints, silence = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    use_dds_profile()
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node(LAST_ZEROS, enable_rosout=False, start_parameter_services=False)
    out = node.create_publisher(Float64MultiArray, topic, COMMAND)
    if _listen(out, Float64MultiArray(data=[0.0] * joints), silence):
        out.wait_for_all_acked(Duration(seconds=1))
    node.destroy_node()
    rclpy.shutdown()
    return 0


def _listen(out: Publisher, zeros: Float64MultiArray, silence: float) -> bool:
    """Send zeros whenever the node falls silent, until it ends; whether it ended while the arm moved."""
    moves = found = False
    while True:
        if not found and out.get_subscription_count() > 0:
            found = os.write(sys.stdout.fileno(), READY) > 0
        timeout = silence if moves else None if found else LOOKS
        heard = select.select([sys.stdin], [], [], timeout)[0]
        words = os.read(sys.stdin.fileno(), 4096) if heard else b""
        if words:
            moves = words[-1:] == MOVES
        elif moves:
            out.publish(zeros)
        if heard and not words:
            break
    for _ in range(REPEATS if moves else 0):
        time.sleep(REPEAT)
        out.publish(zeros)
    return moves


if __name__ == "__main__":
    sys.exit(main())
