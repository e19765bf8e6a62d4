"""Object tracking: `ros2 launch tactile_servoing object_tracking.launch.py scene:=tracking_cube`.

A leader moves a plate, or an object that the follower holds against it; the follower keeps its contact pose
on it. The paper's two parts: all components at once, and with `task_file:=object_tracking_components` one
after the other. With `run:=false` the nodes stay up; then `tactile run object_tracking` runs the task.
"""

from launch import LaunchDescription
from tactile_bringup.launching.launch_description import describe


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    return describe("object_tracking")
