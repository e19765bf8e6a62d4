"""Scene files: what they mean, and what is said about one that is wrong."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from other_package import installed

import tactile_base
from tactile_base.config_paths import config_names, config_path
from tactile_scene import scene_file as scene_file_module
from tactile_scene import simulation
from tactile_scene.scene_file import _ARM_KEYS, SceneError, load_scene

GOOD = """\
description: a test
arms:
  left:
    base: {position: [1.0, 0.0, 0.0], rotation_deg: [0, 0, 90]}
    start: {position: [0.0, 0.0, 0.05], rotation_deg: [0, 180, 0]}
    limits: {linear_velocity: 0.2}
    sensor:
      camera_rate: 60
      touches: [hill]
simulation:
  rate: 120
  sensors:
    left:
      fidelity: ideal
      ideal: {radius: 0.02}
bodies:
  hill:
    shape: dome
    pose: {position: [0.0, 0.0, -0.05]}
    parameters: {radius: 0.05}
  table:
    shape: plane
"""


@pytest.fixture
def scene_file(tmp_path):
    def write(text):
        path = tmp_path / "test.yaml"
        path.write_text(text)
        return path

    return write


def line_of(text, part):
    return next(number for number, line in enumerate(text.splitlines(), 1) if part in line)


def test_a_scene_file_is_read_into_arms_sensors_and_surfaces(scene_file):
    scene = load_scene(scene_file(GOOD))
    assert scene.name == "test"
    assert scene.simulation.rate == 120
    arm = scene.arms["left"]
    assert arm.limits.linear_velocity == 0.2
    assert arm.sensor.settings.touches == ("hill",)
    assert list(scene.bodies_of("left")) == ["hill"]
    assert scene.bodies["hill"].make().distance(np.array([[0.0, 0.0, 0.06]])) == pytest.approx(0.01)


def test_poses_are_positions_in_m_and_extrinsic_xyz_angles_in_degrees(scene_file):
    scene = load_scene(scene_file(GOOD))
    T = scene.arms["left"].T_world_base
    np.testing.assert_array_equal(T, [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    start = scene.arms[
        "left"
    ].T_base_start  # (-1, 0) in the world's axes, seen from a base turned by 90 degrees
    np.testing.assert_allclose(start[:3, 3], [0.0, 1.0, 0.05], atol=1e-13)
    np.testing.assert_allclose(start[:3, 2], [0, 0, -1], atol=1e-13)


@pytest.mark.parametrize("name", ["ramp", "dome", "plane"])
def test_in_the_packaged_scenes_the_sensor_starts_over_the_top_with_y_along_the_path(name):
    scene = load_scene(name)
    arm, (surface,) = scene.arms["arm"], scene.bodies.values()
    T = np.linalg.inv(surface.T_parent_body) @ arm.T_world_start
    gap = surface.make().distance(T[None, :3, 3])[0] - arm.sensor.settings.tip_radius
    assert 0.010 <= gap <= 0.015
    np.testing.assert_array_equal(T[:3, 2], [0, 0, -1])  # into the surface
    np.testing.assert_array_equal(T[:3, 1], [0, 1, 0])  # along the ramp
    ahead = surface.make().closest(T[None, :3, 3] + [[0.0, 0.02, 0.0]])
    assert ahead[0, 2] <= surface.make().closest(T[None, :3, 3])[0, 2]  # nothing is higher
    np.testing.assert_allclose(arm.T_base_start, np.linalg.inv(arm.T_world_base) @ arm.T_world_start)


def test_in_the_scene_of_two_arms_both_start_alike_and_point_at_one_object_from_apart():
    scene = load_scene("two_arms")
    left, right = scene.arms.values()
    assert [arm.name for arm in (left, right)] == ["left", "right"]
    np.testing.assert_allclose(left.T_base_start, right.T_base_start, atol=1e-13)
    (surface,) = scene.bodies.values()
    for arm in (left, right):
        T = np.linalg.inv(surface.T_parent_body) @ arm.T_world_start
        gap = surface.make().distance(T[None, :3, 3])[0] - arm.sensor.settings.tip_radius
        assert 0.010 <= gap <= 0.015
        np.testing.assert_allclose(T[:3, 2], -surface.make().normal(T[None, :3, 3])[0], atol=1e-6)
    assert np.linalg.norm(left.T_world_start[:3, 3] - right.T_world_start[:3, 3]) > 0.1


def test_all_packaged_scenes_load():
    assert {"ramp", "dome", "plane", "two_arms"} <= set(config_names("scenes"))
    for name in config_names("scenes"):
        assert load_scene(name).name == name


@pytest.mark.parametrize(
    "right, wrong, message",
    [
        (
            "shape: dome",
            "shape: dom",
            "bodies.hill.shape: unknown name 'dom' (did you mean 'dome'?); valid: box, cylinder, dome",
        ),
        ("    shape: dome", "    shap: dome", "bodies.hill: unknown name 'shap' (did you mean 'shape'?)"),
        ("parameters: {radius", "parameters: {radios", "unknown name 'radios' (did you mean 'radius'?)"),
        (
            "parameters: {radius: 0.05}",
            "parameters: {radius: -1}",
            "radius = -1.0 m: must lie in [0.005, 10] m",
        ),
        (
            "touches: [hill]",
            "touches: [hil]",
            "unknown name 'hil' (did you mean 'hill'?); valid: hill, table",
        ),
        ("touches: [hill]", "touches: hill", "must be a list of names"),
        (
            "fidelity: ideal",
            "fidelity: real",
            "fidelity: unknown name 'real' (did you mean 'ideal'?); valid: fitted, ideal, image, input",
        ),
        (
            "camera_rate: 60",
            "camera_rate: 50",
            "50 Hz: the simulation's rate, 120 Hz, must be a multiple",
        ),
        ("camera_rate: 60", "camera_rate: fast", "camera_rate = 'fast': must be of type float, is str"),
        (
            "ideal: {radius: 0.02}",
            "ideal: {radius: big}",
            "sensors.left.ideal: radius = 'big': must be of type float",
        ),
        (
            "limits: {linear_velocity",
            "limits: {linear_speed",
            "arms.left.limits: unknown name 'linear_speed'",
        ),
        ("rotation_deg: [0, 180, 0]", "rotation_deg: [0, 180]", "must be a list of 3 finite numbers"),
        ("rotation_deg: [0, 180, 0]", "rotation_deg: [0, .nan, 0]", "must be a list of 3 finite numbers"),
        ("rotation_deg: [0, 180, 0]", "rotation: [0, 180, 0]", "did you mean 'rotation_deg'?"),
        ("ideal: {radius: 0.02}", "delay: 0.6", "sensors.left.delay = 0.6 s: must lie in [0, 0.5]"),
        ("ideal: {radius: 0.02}", "in_tool: {pose: 1}", "unknown name 'pose'; valid: position, rotation_deg"),
        (
            "touches: [hill]",
            "touches: [hill]\n      time_offset: 0.01",
            "time_offset = 0.01 s: a simulated camera has no frames from the future; must be at most 0",
        ),
        ("touches: [hill]", "time_offset: 1", "time_offset = 1.0 s: must lie in [-0.5, 0.5]"),
        ("rate: 120", "rate: 120.5", "must be a whole number of Hz"),
        ("  left:", "  Left Arm:", "'Left Arm' must be lower-case letters"),
        ("arms:", "robots:", "unknown name 'robots'; valid: arms, bodies, description, goals_of, simulation"),
        ("    shape: plane", "    shape: plane\n    shape: ramp", "'shape' is given twice, first in line"),
        ("rate: 120", "rate: [120", "not valid YAML"),
    ],
)
def test_a_mistake_is_named_with_file_line_and_valid_choices(scene_file, right, wrong, message):
    assert right in GOOD
    text = GOOD.replace(right, wrong)
    path = scene_file(text)
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert message in str(caught.value)
    if "YAML" not in message:  # the parser sees an open bracket only later
        line = line_of(text, wrong.splitlines()[-1].strip())
        assert str(caught.value).startswith(f"{path}:{line}:")


@pytest.mark.parametrize(
    "text, message",
    [
        ("", "1: must hold names and values"),
        ("bodies: {}", "1: arms: a scene must have at least one"),
        ("arms: {a: {driver: ur}}", "1: arms.a.start is missing"),
        ("arms: {a: {start: {}, driver: ur5}}", "driver: unknown name 'ur5' (did you mean 'ur'?); valid"),
        ("arms: [a]", "must hold names and values"),
        ("arms:\n  a:\n    start: 3", ":3: arms.a.start = 3: must hold names and values"),
        ("arms:\n  a:\n    start: {}\nbodies:\n  s: {}", ":5: bodies.s.shape is missing"),
    ],
)
def test_a_scene_that_lacks_what_it_needs_is_refused(scene_file, text, message):
    with pytest.raises(SceneError) as caught:
        load_scene(scene_file(text))
    assert message in str(caught.value)


def test_a_number_with_an_exponent_is_a_number(scene_file):
    for text in ("5e-2", "5E-2", "+.5e-1", "5.e-2"):
        scene = load_scene(scene_file(GOOD.replace("{radius: 0.05}", f"{{radius: {text}}}")))
        assert scene.bodies["hill"].parameters.radius == 0.05


def test_a_scene_name_with_a_typo_gives_the_packaged_names():
    with pytest.raises(
        SceneError, match=r"unknown name 'rampp' \(did you mean 'ramp'\?\); valid: .*dome.*plane.*ramp"
    ):
        load_scene("rampp")


def test_a_missing_scene_file_is_named(tmp_path):
    with pytest.raises(SceneError, match=r"none.yaml: no such scene file"):
        load_scene(tmp_path / "none.yaml")


def test_an_image_sensor_starts_from_a_sensor_file(scene_file):
    text = GOOD.replace("fidelity: ideal", "fidelity: image").replace(
        "ideal: {radius: 0.02}", "image: {file: tactip_franka, camera: {gain: 0.9}}"
    )
    model = load_scene(scene_file(text)).simulation.sensors["left"].model
    from tactile_sim.collection import load_sensor

    fitted = load_sensor("tactip_franka").sensor
    assert model.skin == fitted.skin and model.contact == fitted.contact
    assert model.camera == fitted.camera.replaced(gain=0.9)
    with pytest.raises(SceneError, match=r"tactip_frank'.*tactip_franka"):
        load_scene(scene_file(text.replace("file: tactip_franka", "file: tactip_frank")))


def test_settings_of_the_image_sensor_are_groups(scene_file):
    text = GOOD.replace("fidelity: ideal", "fidelity: image").replace(
        "ideal: {radius: 0.02}", "image: {contact: {friction: 0.5}}"
    )
    model = load_scene(scene_file(text)).simulation.sensors["left"].model
    assert model.contact.friction == 0.5
    wrong = text.replace("friction: 0.5", "friktion: 0.5")
    with pytest.raises(
        SceneError, match=r"sensors.left.image.contact: unknown name 'friktion' \(did you mean 'friction'"
    ):
        load_scene(scene_file(wrong))


def test_a_scene_can_be_taken_with_ideal_sensors():
    ideal = load_scene("ramp").with_fidelity("ideal", sigma_position=(0.0, 0.0, 0.0))
    sensor = ideal.simulation.sensors["arm"]
    assert sensor.fidelity == "ideal" and not ideal.gives_images("arm")
    assert sensor.model.sigma_position == (0.0, 0.0, 0.0)
    assert load_scene("ramp").gives_images("arm")


def test_configuration_is_found_where_the_environment_says(tmp_path, monkeypatch):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "mine.yaml").write_text(GOOD)
    monkeypatch.setenv("TACTILE_CONFIG_DIR", str(tmp_path))
    assert config_names("scenes") == ["mine"]
    assert load_scene("mine").path == tmp_path / "scenes" / "mine.yaml"
    with pytest.raises(FileNotFoundError, match=r"did you mean 'mine\.yaml'"):
        config_path("scenes/mime.yaml")


def test_a_missing_configuration_folder_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("TACTILE_CONFIG_DIR", str(tmp_path / "nowhere"))
    with pytest.raises(FileNotFoundError, match="nowhere"):
        config_path("scenes/ramp.yaml")


def documented(language):
    text = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text()
    return re.search(rf"```{language}\n(.*?)```", text, re.DOTALL).group(1)


def test_the_documented_scene_is_the_packaged_one(scene_file):
    shown, packaged = load_scene(scene_file(documented("yaml"))), load_scene("ramp")
    assert shown.bodies["ramp"].parameters == packaged.bodies["ramp"].parameters
    assert shown.arms["arm"].limits == packaged.arms["arm"].limits
    assert shown.arms["arm"].sensor.settings == packaged.arms["arm"].sensor.settings
    np.testing.assert_array_equal(shown.arms["arm"].T_base_start, packaged.arms["arm"].T_base_start)


def test_the_documented_python_runs():
    names = {}
    exec(documented("python"), names)
    assert names["frame"].truth.depth > -0.012 + 0.005 * 1.8


def test_the_page_on_scenes_has_every_name_that_is_no_setting():
    text = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text()
    names = set(_ARM_KEYS)
    for module in (scene_file_module, simulation):
        for call in re.findall(r"\.allow\(([^()]*)\)", Path(module.__file__).read_text()):
            names |= set(re.findall(r'"(\w+)"', call))
    kinematics = {"tool", "tool_radius", "ready_deg"}  # in kinematics.md
    assert len(names) > 25
    assert {
        name for name in names - kinematics if f"`{name}`" not in text and f"{name}:" not in text
    } == set()


def test_installed_configuration_is_found_through_the_prefixes_of_ros(tmp_path, monkeypatch):
    """A copy of the package without a source tree around it, as colcon installs it."""
    site = tmp_path / "lib" / "site-packages"
    shutil.copytree(Path(tactile_base.__file__).parent, site / "tactile_base")
    (site / "config").mkdir()  # somebody else's
    scenes = tmp_path / "prefix" / "share" / "tactile_servoing" / "config" / "scenes"
    scenes.mkdir(parents=True)
    (scenes / "ramp.yaml").write_text(GOOD)
    code = "from tactile_base.config_paths import config_path; print(config_path('scenes/ramp.yaml'))"
    environment = os.environ | {
        "PYTHONPATH": str(site),
        "AMENT_PREFIX_PATH": f"{tmp_path}/none:{tmp_path}/prefix",
    }
    environment.pop("TACTILE_CONFIG_DIR", None)
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()) == scenes / "ramp.yaml"


# What a scene says of arms, cameras and bodies.

CELL = """\
arms:
  leader:
    driver: external
    start: {}
  follower:
    driver: bench_arm
    driver_settings: {host: here}
    start: {position: [0.1, 0.0, 0.0]}
    sensor:
      in_tool: {position: [0.0, 0.0, 0.065]}
      camera: bench_camera
      camera_rate: 50
      tip_radius: 0.025
      model: models/mine.onnx
bodies:
  plate: {shape: plane, carried_by: leader, pose: {position: [0.0, 0.0, 0.2]}}
"""


@pytest.fixture
def other_package(tmp_path, monkeypatch):
    """A package that brings an arm driver and a camera driver."""
    (tmp_path / "site").mkdir()
    for folder in installed(tmp_path / "site"):
        monkeypatch.syspath_prepend(folder)
    yield
    sys.modules.pop("bench_cell", None)


def test_a_scene_of_a_real_cell_needs_no_word_about_simulation(scene_file, other_package):
    scene = load_scene(scene_file(CELL))
    leader, follower = scene.arms.values()
    assert not scene.is_simulated
    assert (leader.driver, follower.driver, follower.sensor.camera) == (
        "external",
        "bench_arm",
        "bench_camera",
    )
    assert follower.driver_settings.values == {"host": "here"}
    assert follower.sensor.settings.tip_radius == 0.025
    assert scene.gives_images("follower") and not scene.gives_images("leader")
    assert scene.model_file("follower") == scene.path.parent / "models/mine.onnx"
    assert load_scene("ramp").model_file("arm") is None
    assert scene.with_fidelity("ideal").gives_images("follower")  # a real camera stays what it is


def test_an_arm_is_controlled_in_its_sensors_frame_and_without_one_in_its_tool(scene_file, other_package):
    leader, follower = load_scene(scene_file(CELL)).arms.values()
    assert (leader.controlled_frame, follower.controlled_frame) == ("tool", "tactile_sensor")
    np.testing.assert_array_equal(leader.T_tool_controlled, np.eye(4))
    np.testing.assert_array_equal(follower.T_tool_controlled[:3, 3], [0, 0, 0.065])


def test_a_carried_body_starts_where_the_tool_is(scene_file, other_package):
    text = CELL.replace("start: {}", "base: {position: [1, 0, 0]}\n    start: {rotation_deg: [0, 90, 0]}")
    scene = load_scene(scene_file(text))
    np.testing.assert_allclose(scene.T_world_body("plate")[:3, 3], [0.2, 0, 0], atol=1e-13)
    np.testing.assert_allclose(scene.T_base_body("leader", "plate")[:3, 3], [-0.8, 0, 0], atol=1e-13)


@pytest.mark.parametrize(
    "right, wrong, message",
    [
        (
            "driver: bench_arm",
            "driver: bench",
            "unknown name 'bench' (did you mean 'bench_arm'?); valid: bench_arm, external, franka, sim",
        ),
        (
            "camera: bench_camera",
            "camera: webcam",
            "valid: bench_camera, digit, double_camera, external, gelsight_mini, replay",
        ),
        ("camera: bench_camera", "camera: sim", "'sim' needs an arm whose driver is 'sim' too"),
        ("driver: external", "driver_settings: {host: x}", "driver_settings: driver 'sim' has none"),
        (
            "driver: external",
            "driver: external\n    driver_settings: {twist_of: hand}",
            "twist_of = 'hand': must be one of sensor, tool",
        ),
        ("carried_by: leader", "carried_by: leeder", "unknown name 'leeder' (did you mean 'leader'?)"),
        ("carried_by: leader", "motion: carried", "a body whose motion is 'carried' needs carried_by"),
        ("carried_by: leader", "motion: fixed, carried_by: leader", "'fixed' cannot have carried_by"),
        ("carried_by: leader", "motion: flying", "unknown name 'flying'; valid: carried, drift, fixed"),
        ("bodies:", "simulation: {sensors: {leader: {}}}\nbodies:", "'leader'; valid: follower"),
    ],
)
def test_what_does_not_fit_together_in_a_cell_is_named(scene_file, other_package, right, wrong, message):
    assert right in CELL
    path = scene_file(CELL.replace(right, wrong))
    with pytest.raises(SceneError) as caught:
        load_scene(path)
    assert message in str(caught.value) and str(caught.value).startswith(f"{path}:")


def test_the_radius_of_a_simulated_tip_is_the_scenes_and_said_once(scene_file):
    sensor = load_scene(scene_file(GOOD)).arms["left"].sensor
    assert sensor.settings.tip_radius == 0.02
    small = load_scene(scene_file(GOOD.replace("{radius: 0.02}", "{radius: 0.015}")))
    assert small.arms["left"].sensor.settings.tip_radius == 0.015
    given = GOOD.replace("camera_rate: 60", "camera_rate: 60\n      tip_radius: 0.03")
    assert load_scene(scene_file(given)).simulation.sensors["left"].model.radius == 0.03
    with pytest.raises(SceneError, match=r"tip_radius = 0.03 m: .*a tip of 0.015 m; leave"):
        load_scene(scene_file(given.replace("{radius: 0.02}", "{radius: 0.015}")))
    assert (
        load_scene("ramp").with_fidelity("ideal", radius=0.01).arms["arm"].sensor.settings.tip_radius == 0.01
    )


def test_reading_a_scene_loads_neither_the_simulated_arm_nor_the_skin():
    code = (
        "import sys; from tactile_scene.scene_file import load_scene; load_scene('two_arms')\n"
        "heavy = ('ruckig', 'tactile_sim.skin', 'tactile_sim._contact', 'cv2', 'scipy')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
