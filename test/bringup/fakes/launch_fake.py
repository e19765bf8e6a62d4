"""Launches the fake cell as `tactile launch` launches a graph: launch_fake.py FOLDER FAULT SECONDS PATHS."""

import sys
from pathlib import Path

from rich.console import Console

from tactile_bringup.graph import Graph, NodeProcess
from tactile_bringup.launching import launcher, task_runner
from tactile_bringup.launching.progress import Display
from tactile_control.task import PathGoal

folder, fault, seconds, paths = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), int(sys.argv[4])
parameters = {"fault": fault, "seconds": seconds}
node = NodeProcess("cell", "/arm", "fake_cell", "fake_cell", parameters)
graph = Graph("surface_following", "fake", ("arm",), (node,), ())
if fault == "never_active":
    task_runner.READY_TIMEOUT = 3.0
with Display(Console(), live=False) as display:
    goals = [PathGoal(name=f"path_{index}") for index in range(paths)]
    outcome = launcher.Launcher(graph, goals, folder, display).run()
print("OUTCOME", outcome.exit_code, outcome.at_rest, outcome.escalated, outcome.reason)
sys.exit(outcome.exit_code)
