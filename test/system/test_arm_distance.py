"""Two known arms in the loop without ROS: the one that moves minds the one that stands."""

import numpy as np
import pytest

from tactile_bringup.offline import OfflineOptions, run_offline
from tactile_control.task_file import load_task
from tactile_scene.scene_file import load_scene

SCENE = """
arms:
  left:
    base: {position: [-0.5, 0.0, 0.0]}
    start: {position: [-0.12, 0.0, 0.4], rotation_deg: [180, 0, 0]}
    safety: {min_arm_distance: DISTANCE}
    kinematics: {description: panda, tool: {position: [0.0, 0.0, 0.1]}}
  right:
    base: {position: [0.5, 0.0, 0.0], rotation_deg: [0, 0, 180]}
    start: {position: [0.12, 0.0, 0.4], rotation_deg: [180, 0, 180]}
    kinematics: {description: fr3, tool: {position: [0.0, 0.0, 0.1]}}
"""
TASK = """
roles: {mover: {task: trajectory}}
scenes:
  cell:
    mover:
      arms: [left]
      goals: [{name: across, displacement: [0.15, 0, 0, 0, 0, 0], speed: 0.05}]
"""


@pytest.mark.parametrize("distance, arrives", [(0.0, True), (0.05, False)])
def test_an_arm_is_held_off_another_that_stands_in_its_way(tmp_path, distance, arrives):
    (tmp_path / "cell.yaml").write_text(SCENE.replace("DISTANCE", str(distance)))
    (tmp_path / "task.yaml").write_text(TASK)
    scene = load_scene(tmp_path / "cell.yaml")
    record = run_offline(scene, load_task(tmp_path / "task.yaml", "cell"), OfflineOptions(seed=1))
    x = record.pose.T_base_sensor[:, 0, 3]
    assert record.result["succeeded"] is arrives, record.result
    if arrives:
        assert x.max() - x[0] == pytest.approx(0.15, abs=1e-3)
    else:
        assert "off its trajectory" in record.result["reason"]
        assert 0.05 < x.max() - x[0] < 0.11 and np.ptp(x[-20:]) < 1e-3
