"""Launches the fake cell as `tactile launch` launches a graph: launch_fake.py FOLDER FAULT SECONDS GOALS.

With the fault "record" a recorder runs beside it.
"""

import sys
import time
from pathlib import Path

from tactile_base import process_limits
from tactile_base.console import lasting_console, say
from tactile_bringup.graph import Graph, NodeProcess
from tactile_bringup.launching import launcher, task_runner
from tactile_bringup.launching.progress import Display
from tactile_bringup.run_sequence import ArmPlan
from tactile_control.task_file import NamedGoal, Role
from tactile_control.tasks.surface_following import FollowingGoal, SurfaceFollowingSettings

folder, fault, seconds, count = Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]), int(sys.argv[4])
parameters = {"fault": fault, "seconds": seconds}
node = NodeProcess("cell", "/arm", "fake_cell", "fake_cell", parameters)
goals = tuple(NamedGoal(f"goal_{index}", FollowingGoal()) for index in range(count))
plan = ArmPlan("arm", Role("follower", "surface_following", SurfaceFollowingSettings(), goals), goals)
nodes = [node]
if fault == "record":
    recorded = {"bag": str(folder / "bag"), "topics": ["/arm/arm/status tactile_msgs/msg/ArmStatus reliable"]}
    nodes.insert(0, NodeProcess("recorder", "/", "fake_recorder", "fake_recorder", recorded))
graph = Graph("surface_following", "fake", Path("fake.yaml"), ("arm",), tuple(nodes), (), (plan,))
if fault == "never_active":
    task_runner.READY_TIMEOUT = 3.0
    process_limits.core_times = lambda: (0.0, time.monotonic())  # there is no time left
if fault == "estop_and_on":
    task_runner.REST_TIMEOUT = 1.5
if fault == "impatient":
    launcher.NAMESAKE_TIMEOUT = 1.0
console = lasting_console()
with Display(console, live=False) as display:
    outcome = launcher.Launcher(graph, folder, display).run()
say(console, f"OUTCOME {outcome.exit_code} {outcome.at_rest} {outcome.escalated} {outcome.reason}")
sys.exit(outcome.exit_code)
