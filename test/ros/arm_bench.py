"""What the tests of the arm node have in common: the other package's arm in a scene, and who commands it."""

import numpy as np

from tactile_ros.conversions import matrix_from_pose

ARM_NODE = "tactile_ros.nodes.arm_node"
TOOL, SENSOR = "arm/tool", "arm/tactile_sensor"
ALONG = np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
SENSOR_TEXT = "sensor: {in_tool: {position: [0, 0, 0.065]}, camera: bench_camera, camera_rate: 30}"


def scene_text(
    driver: str = "bench_arm", settings: str = "{}", safety: str = "{}", sensor: str = SENSOR_TEXT
) -> str:
    """A scene of one arm."""
    return (
        f"arms:\n  arm:\n    driver: {driver}\n    driver_settings: {settings}\n    safety: {safety}\n"
        f"    start: {{position: [0.1, 0.2, 0.3], rotation_deg: [0, 180, 0]}}\n    {sensor}\n"
    )


def keep_commanding(graph, frame: str, until, twist=ALONG) -> None:
    """Send a twist every 20 ms until something holds."""
    ask = graph.commands(frame)
    for _ in graph.ticks(0.02):
        ask(twist)
        if until():
            return
    raise AssertionError("it never held")


def position(poses) -> np.ndarray:
    """Where the arm was last, (3,)."""
    return matrix_from_pose(poses[-1].pose)[:3, 3]
