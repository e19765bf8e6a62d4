"""One arm's nodes beside your own arm and camera, also within your own launch file, once or several times.

`ros2 launch tactile_servoing servoing.launch.py scene:=my_cell.yaml task:=my_task.yaml` starts estimator,
filter, controller and the safe command stage, or the arm's and the camera's driver where the scene names
ours. It simulates nothing and runs no goal: `tactile run my_task.yaml --scene my_cell.yaml` runs them.
"""

from launch import LaunchDescription
from tactile_bringup.launching.launch_description import describe_servoing


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    return describe_servoing()
