"""Bodies of the simulated cell: carried, moved by a model of another package; contact relative to them."""

import sys

import numpy as np
import pytest
from other_package import installed

from tactile_geometry import se3
from tactile_scene.arm import ArmMode
from tactile_scene.scene_file import SceneError, load_scene
from tactile_sim.cell import Cell

EXACT = "ideal: {sigma_position: [0, 0, 0], sigma_rotation: [0, 0, 0]}"
SCENE = """\
arms:
  leader:
    base: {position: [0.1, -0.5, 0.0], rotation_deg: [0, 0, 90]}
    start: {position: [0.0, 0.0, -0.03], rotation_deg: [0, 0, 90]}
  follower:
    base: {position: [-0.5, 0.0, 0.0]}
    start: {position: [0.0, 0.0, 0.019], rotation_deg: [0, 180, 0]}
    sensor: {in_tool: {position: [0.0, 0.0, 0.065]}}
bodies:
  plate: {shape: plane, carried_by: leader, pose: {position: [0.01, 0.02, 0.03]}}
simulation:
  sensors: {follower: {fidelity: FIDELITY, IDEAL}}
"""
DOWN = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])


def scene(tmp_path, text=SCENE, fidelity="ideal"):
    """A leader that carries a plate under a follower whose tip is 1 mm deep in it."""
    path = tmp_path / "carried.yaml"
    path.write_text(text.replace("FIDELITY", fidelity).replace("IDEAL", EXACT))
    return load_scene(path)


def run(cell, steps, **twists):
    """Command each arm its twist for so many steps; the frames of the follower."""
    frames = []
    for _ in range(steps):
        for arm, twist in twists.items():
            cell.command(arm, cell.stamp_ns, twist)
        cell.step()
        if cell.exposure_due("follower"):
            frames.append(cell.expose("follower"))
    return frames


def in_leader(velocity):
    """A twist of the leader's tool, which is turned by 90 degrees about z, for a velocity in the world."""
    x, y, z = velocity
    return np.array([y, -x, z, 0.0, 0.0, 0.0])


def in_follower(velocity):
    """A twist of the follower's sensor, which points down, for a velocity in the world."""
    x, y, z = velocity
    return np.array([-x, y, -z, 0.0, 0.0, 0.0])


def test_a_carried_body_moves_as_one_with_the_tool(tmp_path):
    cell = Cell(scene(tmp_path))
    at_start = cell.T_world_body("plate")
    np.testing.assert_allclose(at_start, cell.scene.T_world_body("plate"))
    np.testing.assert_allclose(at_start[:3, 3], [-0.02, 0.01, 0.0], atol=1e-15)  # turned by 90 degrees
    before = cell.T_base_sensor("leader")
    run(cell, 60, leader=[0.02, 0.01, -0.01, 0.1, 0.2, 0.3])
    moved = cell.T_base_sensor("leader") @ se3.inverse(before)  # in the base
    T_base = cell.scene.arms["leader"].T_world_base
    expected = T_base @ moved @ se3.inverse(T_base) @ at_start
    assert np.linalg.norm(expected[:3, 3] - at_start[:3, 3]) > 0.005
    np.testing.assert_allclose(cell.T_world_body("plate"), expected, atol=1e-12)


@pytest.mark.parametrize("fidelity", ["ideal", "image"])
def test_a_body_moved_under_a_sensor_shears_it_as_the_sensor_moved_over_the_body_does(tmp_path, fidelity):
    velocity = np.array([0.003, -0.004, 0.0])
    described = scene(tmp_path, fidelity=fidelity)
    by_body = run(Cell(described), 60, leader=in_leader(velocity))[-1].truth
    by_sensor = run(Cell(described), 60, follower=in_follower(-velocity))[-1].truth
    assert np.linalg.norm(by_sensor.shear[:2]) > 0.3e-3
    np.testing.assert_allclose(by_body.T_fs, by_sensor.T_fs, atol=1e-6)


@pytest.mark.parametrize("fidelity", ["ideal", "image"])
def test_a_sensor_that_goes_along_with_a_body_feels_no_shear(tmp_path, fidelity):
    velocity = np.array([0.02, 0.01, 0.03])
    cell = Cell(scene(tmp_path, fidelity=fidelity))
    run(cell, 2)
    first = cell.expose("follower").truth
    last = run(cell, 120, leader=in_leader(velocity), follower=in_follower(velocity))[-1]
    assert np.linalg.norm(last.T_base_sensor[:3, 3] - [0.5, 0, 0.019]) > 0.03
    np.testing.assert_allclose(last.truth.T_fs, first.T_fs, atol=1e-5)
    assert last.truth.depth == pytest.approx(0.001, abs=1e-9)


def test_the_truth_of_a_body_that_moves_is_where_it_is_now(tmp_path):
    frame = run(Cell(scene(tmp_path)), 60, leader=in_leader([0.0, 0.0, -0.01]))[-1]
    assert not frame.truth.in_contact
    assert frame.truth.point[2] == pytest.approx(frame.truth.depth - 0.001, abs=1e-9)
    assert frame.truth.point[2] < -0.003


def test_the_arm_that_presses_a_body_into_a_sensor_stops_in_fault_and_may_go_back(tmp_path):
    cell = Cell(scene(tmp_path))
    up, still = in_leader([0.0, 0.0, 0.05]), np.zeros(6)
    run(cell, 60, leader=up, follower=still)
    assert cell.status("follower").mode is not ArmMode.FAULT
    assert cell.status("leader").mode is ArmMode.FAULT
    assert "deep in 'plate', 50 mm/s into it (limit 10 mm)" in cell.status("leader").reason
    depth = cell.expose("follower").truth.depth
    assert 0.0095 < depth < 0.0101
    cell.arm("leader").recover()
    run(cell, 60, leader=-up, follower=still)
    assert cell.status("leader").mode is ArmMode.MOVING
    assert cell.expose("follower").truth.depth < depth - 0.01


def test_the_arm_that_presses_its_sensor_into_a_carried_body_stops_in_fault_and_the_other_does_not(tmp_path):
    cell = Cell(scene(tmp_path))
    run(cell, 240, follower=5 * DOWN, leader=np.zeros(6))
    assert cell.status("follower").mode is ArmMode.FAULT
    assert cell.status("leader").mode is not ArmMode.FAULT


def test_a_sensor_does_not_touch_what_its_own_arm_carries(tmp_path):
    text = SCENE.replace("carried_by: leader", "carried_by: follower")
    described = scene(tmp_path, text)
    assert described.bodies_of("follower") == {}
    assert not run(Cell(described), 10, follower=DOWN)[-1].truth.in_contact
    with pytest.raises(SceneError, match=r"sensor.touches: unknown name 'plate'"):
        scene(tmp_path, text.replace("sensor: {", "sensor: {touches: [plate], "))


# Motions of another package.

DRIFTING = SCENE.replace(
    "carried_by: leader, pose: {position: [0.01, 0.02, 0.03]}", "motion: drift, SETTINGS"
)


@pytest.fixture
def other_package(tmp_path, monkeypatch):
    """A package that brings the motion `drift`."""
    for folder in installed(tmp_path):
        monkeypatch.syspath_prepend(folder)
    yield
    sys.modules.pop("bench_cell", None)


def test_a_motion_of_another_package_moves_its_body(tmp_path, other_package):
    text = DRIFTING.replace("SETTINGS", "motion_settings: {speed: 0.1}, pose: {position: [0, 0, -0.01]}")
    cell = Cell(scene(tmp_path, text))
    run(cell, 120)
    np.testing.assert_allclose(cell.T_world_body("plate")[:3, 3], [0.1, 0.0, -0.01], atol=1e-12)


@pytest.mark.parametrize("fidelity", ["ideal", "image"])
def test_a_motion_is_told_the_contact_of_each_sensor_on_its_body(tmp_path, other_package, fidelity):
    cell = Cell(scene(tmp_path, DRIFTING.replace("SETTINGS", "pose: {position: [0, 0, 0]}"), fidelity))
    run(cell, 3)
    before = cell.T_world_body("plate")
    frame = run(cell, 60, follower=0.1 * DOWN)[-1]
    np.testing.assert_array_equal(cell.T_world_body("plate"), before)  # it stops where it is touched
    contact = cell._bodies["plate"].motion.contacts[-1]
    assert contact.arm == "follower" and contact.truth.surface == "plate"
    T = se3.inverse(before) @ cell.scene.arms["follower"].T_world_base @ frame.T_base_sensor
    np.testing.assert_allclose(contact.T_body_sensor, T, atol=1e-4)  # of the last exposure
    if fidelity == "image":
        assert contact.truth.normal_force > 0.05
        assert -contact.force[2] == pytest.approx(contact.truth.normal_force)  # pressed down
    else:
        assert np.isnan(contact.force).all()


def test_settings_that_a_motion_does_not_know_are_refused_with_file_and_line(tmp_path, other_package):
    described = scene(tmp_path, DRIFTING.replace("SETTINGS", "motion_settings: {sped: 0.1}"))
    with pytest.raises(SceneError, match=r"carried.yaml:10: .*motion_settings: unknown name 'sped'.*'speed'"):
        Cell(described)
