"""The simulated cell: time base, frames, truth, several arms, faults."""

import dataclasses

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_geometry import se3
from tactile_scene.arm import ArmMode
from tactile_scene.scene_file import load_scene
from tactile_scene.shapes import make_surface
from tactile_scene.shapes.surface import contact_pose
from tactile_scene.simulated_sensors import IdealSensorSettings
from tactile_sim.cell import Cell
from tactile_sim.ideal_sensor import IdealSensor

NS = 1_000_000_000
EXACT = {"sigma_position": (0.0, 0.0, 0.0), "sigma_rotation": (0.0, 0.0, 0.0)}


def ideal(scene="plane", **model):
    return load_scene(scene).with_fidelity("ideal", **model)


def run(cell, twists, arm="arm"):
    """Command one twist a step; the frames."""
    frames = []
    for twist in twists:
        cell.command(arm, cell.stamp_ns, twist)
        cell.step()
        if cell.exposure_due(arm):
            frames.append(cell.expose(arm))
    return frames


def down_and_along(depth=0.003, along=0.0, speed=0.03):
    """Twists from the start of a packaged scene, 12 mm above, to a depth, then along +y at 10 mm/s."""
    down = round((0.012 + depth) / speed * 120)
    return (
        [[0, 0, speed, 0, 0, 0]] * down + [[0] * 6] * 10 + [[0, 0.01, 0, 0, 0, 0]] * round(along / 0.01 * 120)
    )


def two_arms(tmp_path, touches=("", "")):
    """A left arm over a plane and a right one over a dome, both 12 mm above, each with a base of its own."""
    sensors = [f"{{{'touches: [' + t + ']' if t else ''}}}" for t in touches]
    path = tmp_path / "two.yaml"
    path.write_text(f"""\
arms:
  left:
    base: {{position: [-0.5, 0, 0]}}
    start: {{position: [0, 0, 0.032], rotation_deg: [0, 180, 0]}}
    sensor: {sensors[0]}
  right:
    base: {{position: [0.9, 0, 0], rotation_deg: [0, 0, 180]}}
    start: {{position: [0.5, 0, 0.072], rotation_deg: [0, 180, 0]}}
    sensor: {sensors[1]}
  blind:
    start: {{position: [0, 1, 1]}}
bodies:
  table: {{shape: plane}}
  hill: {{shape: dome, pose: {{position: [0.5, 0, -0.01]}}, parameters: {{radius: 0.05}}}}
simulation:
  sensors: {{left: {{fidelity: ideal}}, right: {{fidelity: ideal}}}}
""")
    return load_scene(path)


def test_stamps_are_exact_fractions_of_a_second_without_drift():
    cell = Cell(ideal(), stamp_ns=7)
    stamps = [cell.step() for _ in range(1200)]
    assert stamps == [7 + (k * NS) // 120 for k in range(1, 1201)]
    assert stamps[-1] == 7 + 10 * NS


def test_the_camera_exposes_at_its_rate_and_frames_are_numbered():
    frames = run(Cell(ideal()), [[0] * 6] * 120)
    assert len(frames) == 60
    assert [frame.sequence for frame in frames] == list(range(60))
    assert np.diff([frame.stamp_ns for frame in frames]).tolist() == pytest.approx([NS / 60] * 59, abs=1)


def test_a_frame_belongs_to_the_arm_pose_at_its_stamp():
    cell = Cell(ideal("ramp"))
    for frame in run(cell, down_and_along()[:60]):
        last = frame
    assert last.stamp_ns == cell.stamp_ns == cell.status("arm").stamp_ns
    np.testing.assert_array_equal(last.T_base_sensor, cell.T_base_sensor("arm"))


@pytest.mark.parametrize("fidelity", ["ideal", "image"])
@pytest.mark.parametrize("scene", ["plane", "ramp", "dome"])
def test_truth_is_the_geometry_in_the_arm_base(scene, fidelity):
    loaded = load_scene(scene).with_fidelity(fidelity)
    frame = run(Cell(loaded), down_and_along(0.003, along=0.002))[-1]
    truth, T = frame.truth, frame.T_base_sensor
    assert truth.in_contact
    assert truth.depth == pytest.approx(0.003, abs=1e-4)
    np.testing.assert_allclose(T[:3, 3] - truth.point, (0.020 - truth.depth) * truth.normal, atol=1e-9)
    inward = se3.inverse(T)[:3, :3] @ -truth.normal
    np.testing.assert_allclose(truth.T_fs[2, :3], inward, atol=1e-9)  # z of {f} in {s}
    assert truth.normal_angle == pytest.approx(np.arccos(np.clip(inward[2], -1, 1)), abs=1e-6)
    assert truth.T_fs[2, 3] == pytest.approx(truth.depth, abs=1e-12)
    np.testing.assert_allclose(truth.shear[:2], truth.T_fs[:2, 3])
    assert truth.shear[1] > 0.5e-3  # dragged along +y by 2 mm, of which less than 2 mm slipped
    assert (frame.image is not None) == (fidelity == "image")


def test_image_frames_are_grey_pictures_that_change_in_contact():
    frames = run(Cell(load_scene("plane")), down_and_along(0.003))
    assert all(frame.image.shape == (480, 640) and frame.image.dtype == np.uint8 for frame in frames)
    off, pressed = frames[0].image.astype(float), frames[-1].image.astype(float)
    again = frames[1].image.astype(float)
    assert not frames[1].truth.in_contact
    assert np.abs(pressed - off).mean() > 3 * np.abs(again - off).mean()


@pytest.mark.parametrize("fidelity", ["ideal", "image"])
def test_the_same_seed_and_commands_give_the_same_bits(fidelity):
    def record(seed):
        frames = run(
            Cell(load_scene("dome").with_fidelity(fidelity), seed=seed), down_and_along(0.003, along=0.002)
        )
        noisy = [frame.image if fidelity == "image" else frame.estimate for frame in frames]
        return frames[-1].truth.T_fs, [n if fidelity == "image" or n is None else n.mean for n in noisy][-1]

    for first, second in zip(record(3), record(3), strict=True):
        np.testing.assert_array_equal(first, second)
    assert (record(3)[1] != record(4)[1]).any()


def test_two_sensors_share_the_time_and_have_their_own_bases_and_surfaces(tmp_path):
    cell = Cell(two_arms(tmp_path))
    assert cell.arms == ("left", "right", "blind")
    for twist in down_and_along(0.003):
        for arm in ("left", "right"):
            cell.command(arm, cell.stamp_ns, twist)
        cell.step()
    left, right = cell.expose("left"), cell.expose("right")
    assert left.stamp_ns == right.stamp_ns
    assert (left.truth.surface, right.truth.surface) == ("table", "hill")
    np.testing.assert_allclose(left.truth.point, [0.5, 0, 0], atol=1e-9)
    np.testing.assert_allclose(right.truth.point, [0.4, 0, 0.04], atol=1e-9)  # base at x = 0.9, turned by 180
    assert left.truth.depth == pytest.approx(0.003, abs=1e-4)
    assert right.truth.depth == pytest.approx(0.003, abs=1e-4)


def test_two_sensors_on_one_surface_do_not_disturb_each_other():
    scene = ideal("ramp")
    names = ("left", "right")
    simulation = dataclasses.replace(
        scene.simulation, sensors=dict.fromkeys(names, scene.simulation.sensors["arm"])
    )
    arms = {name: dataclasses.replace(scene.arms["arm"], name=name) for name in names}
    both = dataclasses.replace(scene, arms=arms, simulation=simulation)
    cell, alone = Cell(both), Cell(scene)
    for k, twist in enumerate(down_and_along(0.003, along=0.003)):
        cell.command("left", cell.stamp_ns, twist)
        cell.command("right", cell.stamp_ns, [0, 0, 0.02, 0, 0, 0] if k < 60 else [0] * 6)
        alone.command("arm", alone.stamp_ns, twist)
        cell.step()
        alone.step()
        if alone.exposure_due("arm"):
            left, right, single = cell.expose("left"), cell.expose("right"), alone.expose("arm")
    np.testing.assert_array_equal(left.truth.T_fs, single.truth.T_fs)
    assert left.truth.in_contact
    assert not right.truth.in_contact


def test_noise_differs_between_the_sensors_of_a_cell(tmp_path):
    cell = Cell(two_arms(tmp_path), seed=5)
    for twist in down_and_along(0.003):
        for arm in ("left", "right"):
            cell.command(arm, cell.stamp_ns, twist)
        cell.step()
    errors = []
    for arm in ("left", "right"):
        frame = cell.expose(arm)
        errors.append(se3.log(frame.estimate.mean @ frame.truth.T_fs))
    assert np.abs(errors[0] - errors[1]).max() > 1e-5


def test_a_sensor_feels_only_the_surfaces_that_it_touches(tmp_path):
    cell = Cell(two_arms(tmp_path, touches=("hill", "table")))
    for twist in down_and_along(0.003):
        cell.command("left", cell.stamp_ns, twist)
        cell.step()
    frame = cell.expose("left")
    assert frame.truth.surface == "hill"
    assert not frame.truth.in_contact


def test_an_arm_without_sensor_moves_and_cannot_be_exposed(tmp_path):
    cell = Cell(two_arms(tmp_path))
    before = cell.T_base_sensor("blind")
    for _ in range(60):
        cell.command("blind", cell.stamp_ns, [0.01, 0, 0, 0, 0, 0])
        cell.step()
    assert cell.T_base_sensor("blind")[0, 3] - before[0, 3] == pytest.approx(0.005, rel=0.1)
    assert not cell.exposure_due("blind")
    with pytest.raises(ValueError, match="'blind' has no sensor"):
        cell.expose("blind")


def test_an_unknown_arm_is_named_with_those_that_exist():
    with pytest.raises(KeyError, match="did you mean 'arm'"):
        Cell(ideal()).expose("amr")


def test_a_scene_without_surfaces_gives_no_contact(tmp_path):
    path = tmp_path / "empty.yaml"
    path.write_text("arms: {arm: {start: {}, sensor: {}}}\nsimulation: {sensors: {arm: {fidelity: ideal}}}")
    frame = run(Cell(load_scene(path)), [[0, 0, 0.05, 0, 0, 0]] * 60)[-1]
    assert not frame.truth.in_contact
    assert frame.truth.surface == ""
    assert frame.estimate is None


def test_pressing_too_deep_is_a_protective_stop_from_which_the_way_out_is_open():
    cell = Cell(ideal())
    run(cell, down_and_along(0.0115))
    status = cell.status("arm")
    assert status.mode is ArmMode.FAULT
    assert "protective stop: " in status.reason
    assert "deep in 'table', 30 mm/s into it (limit 10 mm)" in status.reason
    depth = cell.expose("arm").truth.depth
    assert 0.0095 < depth < 0.0101
    cell.arm("arm").recover()
    run(cell, [[0, 0, -0.03, 0, 0, 0]] * 60)
    assert cell.status("arm").mode is ArmMode.MOVING
    assert cell.expose("arm").truth.depth < 0.0
    run(cell, [[0, 0, 0.03, 0, 0, 0]] * 120)
    assert cell.status("arm").mode is ArmMode.FAULT


def test_without_commands_the_arm_stops_and_frames_go_on():
    cell = Cell(ideal("ramp"))
    run(cell, down_and_along(0.002, along=0.005))
    for _ in range(24):
        cell.step()
    assert cell.status("arm").mode is ArmMode.RESTING
    assert "no command for" in cell.status("arm").reason
    before = cell.expose("arm").T_base_sensor
    cell.step(10)
    np.testing.assert_array_equal(cell.expose("arm").T_base_sensor, before)


def test_a_scene_without_a_simulated_arm_is_refused():
    scene = ideal()
    real = {name: dataclasses.replace(arm, driver="ur") for name, arm in scene.arms.items()}
    with pytest.raises(ValueError, match="none of its arms has the driver 'sim'"):
        Cell(dataclasses.replace(scene, arms=real))


# The ideal sensor on its own.


def pressed(depth, y=0.0, turn=0.0, tilt=0.0):
    """A sensor over the plane z = 0, shifted along y and turned about the inward normal."""
    T = np.eye(4)
    T[:3, :3] = np.diag([-1.0, 1.0, -1.0])
    T[:3, 3] = [0.0, y, 0.020 - depth]
    local = np.zeros(6)
    local[3:] = [tilt, 0.0, turn]
    return T @ se3.exp(local)


def moved(sensor, poses, surface=None):
    surface = surface or make_surface("plane")
    for pose in poses:
        sensor.advance(surface, pose)
    return sensor.truth()


def test_ideal_shear_is_the_displacement_until_it_slips_and_then_saturates():
    sensor = IdealSensor()
    surface = make_surface("plane")
    truth = moved(sensor, [pressed(0.002, y) for y in np.linspace(0, 0.002, 20)], surface)
    np.testing.assert_allclose(truth.T_fs[:3, 3], [0, 0.002, 0.002], atol=1e-12)
    assert truth.slip_fraction == 0.0
    truth = moved(sensor, [pressed(0.002, y) for y in np.linspace(0.002, 0.010, 20)], surface)
    np.testing.assert_allclose(truth.T_fs[:3, 3], [0, 0.00218, 0.002], atol=1e-12)
    assert truth.slip_fraction == 1.0
    truth = moved(sensor, [pressed(0.002, y) for y in np.linspace(0.010, 0.009, 20)], surface)
    np.testing.assert_allclose(truth.T_fs[:3, 3], [0, 0.00118, 0.002], atol=1e-12)
    assert truth.slip_fraction == 0.0


def test_ideal_turn_is_about_the_inward_normal_and_saturates():
    truth = moved(IdealSensor(), [pressed(0.003, turn=a) for a in np.linspace(0, 0.1, 20)])
    assert np.arctan2(truth.T_fs[1, 0], truth.T_fs[0, 0]) == pytest.approx(0.1, abs=1e-12)
    truth = moved(IdealSensor(), [pressed(0.003, turn=a) for a in np.linspace(0, 0.5, 50)])
    assert np.arctan2(truth.T_fs[1, 0], truth.T_fs[0, 0]) == pytest.approx(0.197, abs=1e-12)


def test_ideal_tilt_without_shear_is_the_geometry():
    surface = make_surface("plane")
    pose = pressed(0.003, tilt=0.3)
    truth = moved(IdealSensor(), [pose], surface)
    np.testing.assert_allclose(truth.T_fs, contact_pose(surface, pose, 0.020).T_fs, atol=1e-13)


def test_ideal_shear_is_forgotten_off_the_surface():
    poses = [pressed(0.002, 0.0), pressed(0.002, 0.002), pressed(-0.001, 0.002), pressed(0.002, 0.003)]
    np.testing.assert_allclose(moved(IdealSensor(), poses).T_fs[:2, 3], 0.0, atol=1e-13)


def test_ideal_estimates_have_the_stated_covariance_about_the_truth():
    sensor = IdealSensor(seed=2)
    truth = moved(sensor, [pressed(0.003, y, tilt=0.2) for y in (0.0, 0.002)])
    estimates = [sensor.estimate() for _ in range(4000)]
    errors = np.array([se3.log(e.mean @ truth.T_fs) for e in estimates])  # X = exp(eps^) X_sf, X_sf^-1 = X_fs
    sigma = np.sqrt(np.diag(estimates[0].cov))
    np.testing.assert_allclose(sigma, [0.534e-3, 0.529e-3, 0.154e-3, 0.0109, 0.0139, 0.0254])
    np.testing.assert_allclose(errors.std(axis=0), sigma, rtol=0.05)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=0.06 * sigma.max())


def test_ideal_estimate_without_contact_is_none():
    sensor = IdealSensor()
    moved(sensor, [pressed(-0.001)])
    assert sensor.estimate() is None


def test_an_ideal_sensor_that_was_nowhere_has_no_truth():
    with pytest.raises(RuntimeError, match="before the first advance"):
        IdealSensor().truth()


def test_tables_of_unequal_length_are_refused():
    with pytest.raises(SettingError, match="must be of one length"):
        IdealSensorSettings(shear_depths=(0.0, 0.001))


def with_faults(scene, time_offset=0.0, **faults):
    """The scene with what its sensor's simulation says that nobody knows, and a correction of stamps."""
    sensors = {"arm": dataclasses.replace(scene.simulation.sensors["arm"], **faults)}
    arm = scene.arms["arm"]
    settings = arm.sensor.settings.replaced(time_offset=time_offset)
    arm = dataclasses.replace(arm, sensor=dataclasses.replace(arm.sensor, settings=settings))
    simulation = dataclasses.replace(scene.simulation, sensors=sensors)
    return dataclasses.replace(scene, arms={"arm": arm}, simulation=simulation)


def test_late_frames_show_what_was_and_are_stamped_when_they_come():
    twists = down_and_along(depth=0.003, along=0.01)
    exact = run(Cell(ideal(**EXACT), seed=1), twists)
    late = run(Cell(with_faults(ideal(**EXACT), delay=0.025), seed=1), twists)
    for before, after in zip(exact, late, strict=False):
        assert after.stamp_ns == before.stamp_ns + 25_000_000
        assert after.truth.depth == before.truth.depth
        moved = np.linalg.norm(after.T_base_sensor[:3, 3] - before.T_base_sensor[:3, 3])
        assert moved < 0.031 * 0.025


def test_a_time_offset_in_the_scene_makes_up_for_a_late_camera():
    twists = down_and_along(depth=0.003, along=0.01)
    exact = {frame.stamp_ns: frame for frame in run(Cell(ideal(**EXACT), seed=1), twists)}
    late = run(Cell(with_faults(ideal(**EXACT), delay=0.025, time_offset=-0.025), seed=1), twists)
    assert len(late) > 20
    for frame in late:
        same = exact[frame.stamp_ns]
        np.testing.assert_allclose(frame.T_base_sensor, same.T_base_sensor, atol=1e-12)
        assert frame.truth.depth == same.truth.depth


def test_a_sensor_that_is_not_where_the_scene_says_touches_elsewhere():
    said = ideal(**EXACT)
    T_said = said.arms["arm"].sensor.T_tool_sensor
    off = se3.pose_from_euler([0.002, 0.0, 0.001, 0.0, np.radians(3.0), 0.0])
    where = tuple(se3.euler_from_pose(T_said @ off))
    frames = run(Cell(with_faults(said, in_tool=where), seed=1), down_and_along(depth=0.003))
    frame = frames[-1]
    tip = frame.T_base_sensor @ off
    assert frame.truth.depth == pytest.approx(0.020 - tip[2, 3], abs=1e-9)
    assert frame.truth.normal_angle == pytest.approx(np.radians(3.0), abs=1e-9)
