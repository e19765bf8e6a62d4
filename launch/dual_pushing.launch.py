"""Dual-arm pushing: `ros2 launch tactile_servoing dual_pushing.launch.py scene:=dual_pushing_tall`.

The paper's Task 4: the leader pushes an object to a target, the follower steadies it from the other side.
With `run:=false` the nodes stay up and the task is started by hand: `tactile run dual_pushing`.
"""

from launch import LaunchDescription
from tactile_bringup.launching.launch_description import describe


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    return describe("dual_pushing")
