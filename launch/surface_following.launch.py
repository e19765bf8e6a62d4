"""Surface following: `ros2 launch tactile_servoing surface_following.launch.py scene:=dome record:=my_bag`.

Starts the nodes of the scene, runs its paths once all nodes are active, and ends. With `run:=false` the nodes
stay up and the task is started by hand, as often as wanted: `tactile run surface_following --scene dome`.
"""

from launch import LaunchDescription
from tactile_bringup.launching.launch_description import describe


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    return describe("surface_following")
