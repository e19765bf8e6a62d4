"""`tactile launch` with estimator, filter and controller of an arm in one process: for comparison.

Takes the arguments of `tactile launch`; `latency_under_load.py --composed` runs it. One hop through
the middleware costs less inside a process, but a fault of one node then ends all three.
"""

import sys
from pathlib import Path

from tactile_bringup import cli
from tactile_bringup.graph import NodeProcess

CHAIN = ("estimator", "filter", "controller")
IDLE = "import signal, sys; signal.signal(signal.SIGINT, lambda *_: sys.exit(0)); signal.pause()"
ALL = """
import sys
from tactile_ros.run_nodes import run
from tactile_ros.nodes.controller_node import ControllerNode
from tactile_ros.nodes.estimator_node import EstimatorNode
from tactile_ros.nodes.filter_node import FilterNode
sys.exit(run(lambda: [EstimatorNode(), FilterNode(), ControllerNode()]))
"""


def composed(alone):
    """The command of a node: the last of the chain runs all three, the others only wait for their end."""

    def command(self: NodeProcess, parameter_file: Path, python: str = sys.executable) -> list[str]:
        if self.name not in CHAIN:
            return alone(self, parameter_file, python)
        if self.name != CHAIN[-1]:
            return [python, "-c", IDLE]
        prefix = str(parameter_file)
        files = [prefix.replace(f".{CHAIN[-1]}", f".{name}") for name in CHAIN]
        given = [word for file in files for word in ("--params-file", file)]
        return [python, "-c", ALL, "--ros-args", "-r", f"__ns:={self.namespace}", *given]

    return command


if __name__ == "__main__":
    NodeProcess.command = composed(NodeProcess.command)
    sys.exit(cli.main(["launch", *sys.argv[1:]]))
