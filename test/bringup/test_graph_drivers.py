"""Which processes stand for the arms and cameras of a scene: simulated, of a driver, or running already."""

import sys
from pathlib import Path

import pytest
from other_package import installed

from tactile_base.settings import SettingError
from tactile_bringup import cell_touching
from tactile_bringup.graph import GraphOptions, build_graph, load_graph
from tactile_bringup.run_sequence import arm_plans
from tactile_scene.scene_file import load_scene

SCENE = """\
arms:
  arm:
    driver: DRIVER
    start: {position: [0.0, 0.0, 0.032], rotation_deg: [0, 180, 0]}
    sensor: {in_tool: {position: [0.0, 0.0, 0.065]}, model: MODEL, camera: CAMERA, camera_rate: 40}
bodies:
  table: {shape: plane}
"""


@pytest.fixture
def graph_of(tmp_path, monkeypatch):
    """The graph of surface following on a scene with this driver and camera."""
    (tmp_path / "site").mkdir()
    for folder in installed(tmp_path / "site"):
        monkeypatch.syspath_prepend(folder)

    def make(driver: str, camera: str, options: GraphOptions | None = None, model: str = "mine.onnx"):
        path = tmp_path / "plane.yaml"
        path.write_text(SCENE.replace("DRIVER", driver).replace("CAMERA", camera).replace("MODEL", model))
        return load_graph("surface_following", str(path), options or GraphOptions(rate=20.0, seed=3))

    yield make
    sys.modules.pop("bench_cell", None)


def names(graph) -> list[str]:
    return [node.full_name for node in graph.nodes]


CHAIN = ["/arm/estimator", "/arm/filter", "/arm/controller"]


@pytest.mark.parametrize(
    "driver, camera, drivers",
    [
        ("sim", "sim", ["/sim"]),
        ("sim", "bench_camera", ["/sim", "/arm/camera"]),
        ("bench_arm", "bench_camera", ["/arm/arm", "/arm/camera"]),
        ("bench_arm", "external", ["/arm/arm"]),
        ("external", "bench_camera", ["/arm/arm", "/arm/camera"]),
        ("external", "external", ["/arm/arm"]),
    ],
)
def test_what_does_not_run_already_gets_a_process_and_an_external_arm_its_stage(
    graph_of, driver, camera, drivers
):
    graph = graph_of(driver, camera)
    assert names(graph) == drivers + CHAIN
    for name in drivers:
        assert Path(graph.node(name).parameters["scene"]).name == "plane.yaml"


def test_a_real_sensor_keeps_its_own_rate_and_model(graph_of):
    graph = graph_of("bench_arm", "bench_camera")
    parameters = graph.node("/arm/estimator").parameters
    assert parameters["images.rate"] == 40.0  # --rate is that of simulated cameras
    assert parameters["model"] == str(graph.scene_file.parent / "mine.onnx")
    assert "seed" not in graph.node("/arm/arm").parameters
    assert not graph.remarks


def test_a_real_sensor_without_a_model_of_its_own_is_told_of(graph_of):
    remarks = graph_of("bench_arm", "bench_camera", model="''").remarks
    assert len(remarks) == 1 and remarks[0].startswith("arm: the shipped model has seen simulated images")
    assert not load_graph("surface_following", "plane").remarks


def test_images_of_somebody_elses_camera_are_taken_compressed_where_the_scene_says_so(graph_of, tmp_path):
    compressed = "external, camera_settings: {transport: compressed}"
    graph = graph_of("bench_arm", compressed, GraphOptions(marker_view=True))
    assert graph.node("/arm/estimator").parameters["images.transport"] == "compressed"
    assert graph.node("/arm/marker_view").parameters["transport"] == "compressed"
    recorded = graph_of("bench_arm", compressed, GraphOptions(record=tmp_path / "bag", record_images=True))
    topics, images = (recorded.node("/recorder").parameters[name] for name in ("topics", "images"))
    assert "/arm/tactile/image/compressed sensor_msgs/msg/CompressedImage sensor" in topics and not images
    without = graph_of("bench_arm", compressed, GraphOptions(record=tmp_path / "bag"))
    assert not any("compressed" in topic for topic in without.node("/recorder").parameters["topics"])


def test_stamps_of_somebody_elses_camera_are_corrected_by_those_who_take_its_images(graph_of):
    options = GraphOptions(marker_view=True)
    graph = graph_of("bench_arm", "external, time_offset: -0.012", options)
    assert graph.node("/arm/estimator").parameters["images.time_offset"] == -0.012
    assert graph.node("/arm/marker_view").parameters["time_offset"] == -0.012
    ours = graph_of("bench_arm", "bench_camera, time_offset: -0.012", options)  # the camera node does it
    assert "images.time_offset" not in ours.node("/arm/estimator").parameters


def test_a_calibration_by_touch_runs_on_the_graph_of_any_arm_with_the_settings_of_its_task(graph_of):
    scene = load_scene(graph_of("bench_arm", "bench_camera").scene_file)
    task = cell_touching.task_of(scene, "arm", "time", periods=20)
    graph = build_graph(task.name, scene, arm_plans(task, scene), GraphOptions())
    assert names(graph) == ["/arm/arm", "/arm/camera", *CHAIN]
    parameters = graph.node("/arm/controller").parameters
    assert parameters["task_name"] == "touching" and parameters["watchdog.patience"] == 5.0
    (plan,) = graph.plans
    assert plan.goals[0].start is not None and plan.goals[0].goal.periods == 20


@pytest.mark.parametrize(
    "settings, complaint",
    [
        ("{transport: theora}", "transport = 'theora': must be one of raw, compressed"),
        ("{device: /dev/video0}", "unknown name 'device'; valid: transport"),
    ],
)
def test_settings_that_an_external_camera_does_not_have_are_refused_with_the_line(
    graph_of, settings, complaint
):
    with pytest.raises(SettingError, match=complaint) as error:
        graph_of("bench_arm", f"external, camera_settings: {settings}")
    assert "plane.yaml:5" in str(error.value)
