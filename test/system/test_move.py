"""A move to a pose over ROS, and through the driver of a UR against the double of its controller."""

import re
import sys
import time

import numpy as np
import pytest
from launched import Launched

from tactile_control.phases import StampedPose, TaskInputs
from tactile_control.tasks.move import Move, MoveGoal, MoveTaskSettings

pytestmark = pytest.mark.live

SCENE = """
arms:
  arm:
    start: {position: [0.0, 0.0, 0.1], rotation_deg: [180, 0, 0]}
    sensor: {camera_rate: 30}
simulation: {rate: 60, sensors: {arm: {fidelity: ideal}}}
"""


@pytest.mark.ros
def test_an_arm_is_taken_to_a_pose_by_a_command(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    scene = tmp_path / "cell.yaml"
    scene.write_text(SCENE)
    words = ["move", "--scene", str(scene), "--to", "0.005", "-0.01", "0.12", "--speed", "0.05", "--headless"]
    launch = Launched(tmp_path, [sys.executable, "-m", "tactile_bringup.cli", *words, "--out", str(tmp_path)])
    try:
        assert launch.end() == 0, launch.output
    finally:
        launch.kill()
    way = re.search(r"pose: done \((\d+) mm", launch.output)
    assert way and 60 <= int(way[1]) <= 80, launch.output  # up, across and down
    assert "stopped: the arm rests" in launch.output


def test_a_move_through_the_driver_of_a_ur_ends_at_the_pose(tmp_path):
    pytest.importorskip("rtde_control", reason="ur_rtde has no wheel for this Python or machine")
    from real_arm import Cell, address
    from ur_cell import Double, scene_file

    double = Double(address())
    cell = Cell(scene_file(tmp_path, double.host, state_timeout=0.5))
    try:
        cell.until(lambda: not cell.command(np.zeros(6)), "state of the arm")
        there = cell.state.T_base_controlled[:3, 3] + [0.02, -0.015, 0.01]
        task = Move(MoveTaskSettings(), MoveGoal(tuple(there.tolist())))
        while True:
            state = cell.state
            pose = StampedPose(state.stamp_ns, state.T_base_controlled)
            command = task.step(time.time_ns(), TaskInputs(sensor_pose=pose))
            refusal = cell.command(command.twist)
            assert not refusal
            if command.done:
                break
            time.sleep(0.01)
        assert command.succeeded, command.reason
        cell.rest()
        assert np.linalg.norm(cell.state.T_base_controlled[:3, 3] - there) < 1e-3
        speeds = np.array([state.twist for state in cell.states])
        assert np.linalg.norm(speeds[:, :3], axis=1).max() <= MoveTaskSettings().travel.speed + 1e-3
    finally:
        cell.close()
        double.close()
