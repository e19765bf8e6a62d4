"""Our nodes for two arms that run already; the arguments are those of `servoing.launch.py`."""

from launch.actions import GroupAction, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import PushRosNamespace
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def servoing(**arguments):
    file = PathJoinSubstitution([FindPackageShare("tactile_servoing"), "launch", "servoing.launch.py"])
    given = {"task": "my_task.yaml", "scene": "my_cell.yaml", **arguments}
    return IncludeLaunchDescription(PythonLaunchDescriptionSource(file), launch_arguments=given.items())


def generate_launch_description():
    left = servoing(image_topic="/cameras/left/image_raw")
    right = servoing(namespace="right", base_frame="base_link", tool_frame="tool0", sensor_frame="tactip")
    return LaunchDescription([GroupAction([PushRosNamespace("lab"), left]), GroupAction([right])])
