"""Single-arm pushing: `ros2 launch tactile_servoing pushing.launch.py record:=my_bag`.

The paper's Task 3: the arm pushes an object over the floor to a target around a corner. With `run:=false` the
nodes stay up and the task is started by hand: `tactile run pushing`.
"""

from launch import LaunchDescription
from tactile_bringup.launching.launch_description import describe


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    return describe("pushing")
