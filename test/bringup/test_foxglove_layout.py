"""The layout for Foxglove and Lichtblick: panels that they have, on topics and fields that the graph has."""

import json
import re

import pytest
from rosbags.interfaces import Nodetype

from tactile_base.topics import IMAGE, compressed
from tactile_bringup.graph import GraphOptions, load_graph
from tactile_bringup.launching.foxglove_layout import write_layout
from tactile_wire.message_definitions import type_fields

GRAPHS = [
    ("surface_following", "ramp"),
    ("surface_following", "two_arms"),
    ("object_tracking", "tracking_flat"),
    ("pushing", "pushing"),
    ("dual_pushing", "dual_pushing"),
]
TITLE = {"lichtblickPanelTitle", "foxglovePanelTitle"}
#: Kind of panel -> its settings, those of lichtblick-suite/lichtblick 1.28 (packages/suite-base/src/panels).
PANELS = {
    "3D": {"followTf", "followMode", "cameraState", "scene", "topics", "imageMode", "transforms", "layers"},
    "Image": {"imageMode"},
    "Plot": {"paths", "legendDisplay", "showLegend", "sidebarDimension", "followingViewWidth"} | TITLE,
    "StateTransitions": {"paths", "isSynced"} | TITLE,
    "RosOut": {"topicToRender", "minLogLevel", "searchTerms", "nameFilter"},
    "DiagnosticSummary": {"topicToRender", "minLevel", "pinnedIds", "hardwareIdFilter", "sortByLevel"},
    "Tab": {"activeTabIdx", "tabs"},
}
PATH = {"value", "label", "enabled", "timestampMethod", "color", "showLine", "lineSize"}
#: What each kind of panel can show, by `convertMessage` and the `*_DATATYPES` there.
SHOWN = {
    "3D": {
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        "geometry_msgs/msg/PoseArray",
        "visualization_msgs/msg/MarkerArray",
    },
    "Image": {"sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"},
    "RosOut": {"rcl_interfaces/msg/Log"},
    "DiagnosticSummary": {"diagnostic_msgs/msg/DiagnosticArray"},
}


@pytest.fixture(scope="module", params=GRAPHS, ids=[f"{task}-{scene}" for task, scene in GRAPHS])
def shown(request, tmp_path_factory):
    """Type of each topic of a graph that is recorded with its images, and its layout."""
    folder = tmp_path_factory.mktemp("run")
    options = GraphOptions(record=folder / "bag", record_images=True)
    graph = load_graph(*request.param, options)
    images = [topic.of(arm) for arm in graph.arms for topic in (IMAGE, compressed(IMAGE))]
    types = {topic.name: topic.type for topic in (*graph.topics, *images)}
    return types, json.loads(write_layout(graph, folder).read_text())


def kind(panel):
    return panel.partition("!")[0]


def topics(panel, values):
    """The topics that a panel shows whole."""
    if "topicToRender" in values:
        return [values["topicToRender"]]
    image = values.get("imageMode", {}).get("imageTopic")
    return [image] if image else list(values.get("topics", {}))


def places(node):
    """The panels in a tree of splits."""
    if isinstance(node, str):
        return [node]
    assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
    return places(node["first"]) + places(node["second"])


def element(fields, type_name, path):
    """The primitive type at a message path; a KeyError or an assertion where there is none."""
    for step in path.split("."):
        name, index = re.fullmatch(r"(\w+)(?:\[(\d+)\])?", step).groups()
        node, content = dict(fields[type_name][1])[name]
        if index is not None:
            assert node in (Nodetype.ARRAY, Nodetype.SEQUENCE) and int(index) < (content[1] or 1 << 30)
            node, content = content[0]
        type_name = content if node == Nodetype.NAME else None
    assert node == Nodetype.BASE, path
    return content[0]


def test_every_panel_and_setting_is_one_that_they_have(shown):
    for panel, values in shown[1]["configById"].items():
        assert set(values) <= PANELS[kind(panel)], panel
        for path in values.get("paths", ()):
            assert set(path) <= PATH, panel


def test_every_panel_has_one_place(shown):
    panels = shown[1]["configById"]
    tabs = [
        place
        for values in panels.values()
        for tab in values.get("tabs", ())
        for place in places(tab["layout"])
    ]
    assert sorted(places(shown[1]["layout"]) + tabs) == sorted(panels)


def test_every_topic_is_in_the_graph_and_of_a_type_that_its_panel_shows(shown):
    types, layout = shown
    found = {panel: topics(panel, values) for panel, values in layout["configById"].items()}
    for panel, names in found.items():
        for name in names:
            assert types[name] in SHOWN[kind(panel)], (panel, name)
    assert {"3D!scene", "RosOut!log", "DiagnosticSummary!nodes"} <= {panel for panel in found if found[panel]}


def test_every_path_leads_to_a_value_of_the_message(shown):
    types, layout = shown
    count = 0
    for panel, values in layout["configById"].items():
        for path in values.get("paths", ()):
            topic, _, field = path["value"].partition(".")
            primitive = element(type_fields(types[topic]), types[topic], field)
            assert primitive.startswith("float") or kind(panel) == "StateTransitions", path["value"]
            count += 1
    assert count >= 8
