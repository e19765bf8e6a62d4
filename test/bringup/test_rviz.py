"""RViz's display files hold classes, properties and values that RViz has, and qualities of service that fit.

The names are those of ros2/rviz (rolling, 2025): `plugins_description.xml` of rviz_default_plugins and
rviz_common, the constructors of the displays, `covariance_property.cpp`, `qos_profile_property.cpp`,
`message_filter_display.hpp`, `orbit_view_controller.cpp`. RViz itself is not among the wheels, so no display
has been rendered here.
"""

import pytest
import yaml

from tactile_base.topics import IMAGE as IMAGES
from tactile_base.topics import LATCHED, MARKER_VIEW, SENSOR
from tactile_bringup.graph import GraphOptions, load_graph
from tactile_bringup.launching.view import write_view

GRAPHS = [
    ("surface_following", "ramp"),
    ("surface_following", "two_arms"),
    ("object_tracking", "tracking_flat"),
    ("pushing", "pushing"),
    ("dual_pushing", "dual_pushing"),
]
DISPLAY = {"Class", "Name", "Enabled", "Value"}
QOS = {"Value", "Depth", "History Policy", "Reliability Policy", "Durability Policy"}
FILTERED = QOS | {"Filter size"}  # of displays that wait for transforms
POLICIES = {
    "History Policy": {"System Default", "Keep Last", "Keep All"},
    "Reliability Policy": {"System Default", "Reliable", "Best Effort"},
    "Durability Policy": {"System Default", "Transient Local", "Volatile"},
}
COVARIANCE = {
    "Value": None,
    "Position": {"Value", "Color", "Alpha", "Scale"},
    "Orientation": {"Value", "Frame", "Color Style", "Color", "Alpha", "Offset", "Scale"},
}
IMAGE = {"Topic": QOS} | dict.fromkeys(("Normalize Range", "Min Value", "Max Value", "Median window"))
POSE = dict.fromkeys(
    ("Shape", "Color", "Alpha", "Shaft Length", "Shaft Radius", "Head Length", "Head Radius", "Axes Length",
     "Axes Radius")
)  # fmt: skip
TWIST = dict.fromkeys(
    ("Linear Color", "Angular Color", "Alpha", "Linear Arrow Scale", "Angular Arrow Scale", "Arrow Width",
     "History Length", "Hide Small Values")
)  # fmt: skip
#: Class -> message type (None: no topic) and properties, with those that a property has itself.
DISPLAYS = {
    "rviz_default_plugins/Grid": (None, dict.fromkeys(
        ("Reference Frame", "Plane Cell Count", "Normal Cell Count", "Cell Size", "Line Style", "Color",
         "Alpha", "Plane", "Offset"))),
    "rviz_default_plugins/TF": (None, {"Frames": {"All Enabled"}} | dict.fromkeys(
        ("Show Names", "Show Axes", "Show Arrows", "Marker Scale", "Update Interval", "Frame Timeout",
         "Tree"))),
    "rviz_default_plugins/MarkerArray": (
        "visualization_msgs/msg/MarkerArray", {"Topic": QOS, "Namespaces": set()}),
    "rviz_default_plugins/PoseWithCovariance": (
        "geometry_msgs/msg/PoseWithCovarianceStamped", {"Topic": FILTERED, "Covariance": COVARIANCE} | POSE),
    "rviz_default_plugins/TwistStamped": ("geometry_msgs/msg/TwistStamped", {"Topic": FILTERED} | TWIST),
    "rviz_default_plugins/Image": ("sensor_msgs/msg/Image", IMAGE),
    "rviz_default_plugins/RobotModel": ("std_msgs/msg/String", {"Description Topic": QOS} | dict.fromkeys(
        ("Visual Enabled", "Collision Enabled", "Mass Properties", "Update Interval", "Alpha",
         "Description Source", "Description File", "TF Prefix"))),
}  # fmt: skip
CHOICES = {
    "Plane": {"XY", "XZ", "YZ"}, "Shape": {"Arrow", "Axes"}, "Frame": {"Local", "Fixed"},
    "Color Style": {"Unique", "RGB"}, "Description Source": {"Topic", "File"}, **POLICIES,
}  # fmt: skip
PANELS = {"Displays", "Help", "Selection", "Time", "Tool Properties", "Transformation", "Views"}
TOOLS = {
    "FocusCamera",
    "Interact",
    "Measure",
    "MoveCamera",
    "PublishPoint",
    "Select",
    "SetGoal",
    "SetInitialPose",
}
ORBIT = {
    "Class", "Name", "Value", "Distance", "Focal Shape Size", "Focal Shape Fixed Size", "Yaw", "Pitch",
    "Focal Point", "Target Frame", "Near Clip Distance", "Invert Z Axis", "Enable Stereo Rendering",
}  # fmt: skip


@pytest.fixture(params=GRAPHS, ids=[f"{task}-{scene}" for task, scene in GRAPHS])
def view(request, tmp_path):
    """A graph with all that can be asked for, and its display file's contents."""
    graph = load_graph(*request.param, GraphOptions(object_belief=True, marker_view=True))
    return graph, yaml.safe_load(write_view(graph, tmp_path).read_text())


def check(values, known, place):
    """Every name is known, down to the last level, and every choice is one of RViz's."""
    for name, value in values.items():
        assert name in known, f"{place}: RViz has no property '{name}'"
        if name in CHOICES and isinstance(value, str):
            assert value in CHOICES[name], f"{place}.{name}: {value}"
        inner = known[name] if isinstance(known, dict) else None
        if isinstance(value, dict) and inner:
            check(value, inner, f"{place}.{name}")


def topics_of(display):
    return [display[name] for name in ("Topic", "Description Topic") if name in display]


def test_every_display_and_property_is_one_of_rviz(view):
    _, config = view
    for display in config["Visualization Manager"]["Displays"]:
        _, properties = DISPLAYS[display["Class"]]
        check(display, dict.fromkeys(DISPLAY) | properties, display["Name"])


def test_every_topic_has_the_type_of_its_display_and_a_quality_of_service_that_connects(view):
    graph, config = view
    pictures = [topic.of(arm) for arm in graph.arms for topic in (IMAGES, MARKER_VIEW)]
    published = {topic.name: topic for topic in (*graph.topics, *pictures)}
    shown = 0
    for display in config["Visualization Manager"]["Displays"]:
        for given in topics_of(display):
            topic = published.get(given["Value"])
            assert topic is not None or not display["Enabled"], given["Value"]
            if topic is None:
                continue
            shown += 1
            assert topic.type == DISPLAYS[display["Class"]][0], display["Name"]
            # who asks for more than is offered gets nothing: best effort for reliable, volatile for latched
            if topic.qos == SENSOR:
                assert given["Reliability Policy"] == "Best Effort", display["Name"]
            # who comes late to what is said once has to ask for it
            wanted = "Transient Local" if topic.qos == LATCHED else "Volatile"
            assert given["Durability Policy"] == wanted, display["Name"]
    assert shown >= 4


def test_panels_tools_and_camera_are_those_of_rviz(view):
    _, config = view
    assert {panel["Class"].removeprefix("rviz_common/") for panel in config["Panels"]} <= PANELS
    manager = config["Visualization Manager"]
    assert {tool["Class"].removeprefix("rviz_default_plugins/") for tool in manager["Tools"]} <= TOOLS
    assert manager["Transformation"]["Current"]["Class"] == "rviz_default_plugins/TF"
    assert set(manager["Global Options"]) <= {"Background Color", "Fixed Frame", "Frame Rate"}
    assert manager["Views"]["Current"]["Class"] == "rviz_default_plugins/Orbit"
    assert set(manager["Views"]["Current"]) <= ORBIT
