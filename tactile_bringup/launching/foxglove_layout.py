"""What Foxglove and Lichtblick show of a graph: panels on its topics, as a layout that both import.

The names of panels and of their settings are those of lichtblick-suite/lichtblick 1.28 (packages/suite-base,
`src/panels/*/types.ts`, `Plot/utils/config.ts`, `ThreeDeeRender/IRenderer.ts`).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tactile_base.topics import (
    ARM_STATUS,
    BELIEF,
    CONTROLLER_STATUS,
    DIAGNOSTICS,
    IMAGE,
    PATH,
    PRESENCE,
    ROSOUT,
    SIM_MARKERS,
    STATE,
    Topic,
    compressed,
    sensor_frame,
    tool_frame,
)
from tactile_bringup.graph import RECORDER, Graph
from tactile_scene.camera import COMPRESSED

FILE = "foxglove.json"
INFO = 2  # of the levels of a log panel
#: Elements of an Euler surface contact pose: title, names, first. Plots over time turn no rad into deg.
CONTACT = (("position on the surface (m)", "xyz", 0), ("angles to the surface (rad)", "αβγ", 3))


def write_layout(graph: Graph, folder: Path) -> Path:
    """Write the graph's layout into a folder that is there; returns its path."""
    path = folder / FILE
    path.write_text(json.dumps(layout(graph), indent=1))
    return path


def layout(graph: Graph) -> dict[str, Any]:
    """The settings of each panel by its id, and how the panels share the window."""
    panels = {
        "3D!scene": _scene(graph),
        "RosOut!log": {"topicToRender": ROSOUT.name, "minLogLevel": INFO, "searchTerms": []},
        "DiagnosticSummary!nodes": {"topicToRender": DIAGNOSTICS.name, "minLevel": 0, "pinnedIds": []},
    }
    shared = _split("column", ["3D!scene", _split("row", ["RosOut!log", "DiagnosticSummary!nodes"])], 70)
    columns = []
    for arm in graph.arms:
        of_arm = {f"{kind}!{arm}_{name}": values for kind, name, values in _panels_of(graph, arm)}
        panels |= of_arm
        tabs = [tab["layout"] for values in of_arm.values() for tab in values.get("tabs", ())]
        columns.append(_split("column", [panel for panel in of_arm if panel not in tabs], 28))
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("row", [shared, *columns], 100 * 1.2 / (1.2 + len(columns))),
    }


def _split(direction: str, parts: Sequence[Any], first: float | None = None) -> Any:
    """Parts side by side ("row") or below each other ("column"); `first` (percent) is what the first gets."""
    if len(parts) == 1:
        return parts[0]
    return {
        "direction": direction,
        "first": parts[0],
        "second": _split(direction, parts[1:]),
        "splitPercentage": first or 100 / len(parts),
    }


def _feels(graph: Graph, arm: str) -> bool:
    return any(node.full_name == f"/{arm}/filter" for node in graph.nodes)


def _scene(graph: Graph) -> dict[str, Any]:
    """The arms; the camera moves with the first one's tip that feels something."""
    first = next((arm for arm in graph.arms if _feels(graph, arm)), graph.arms[0])
    seen: dict[str, Any] = {SIM_MARKERS.name: {}}
    for arm in graph.arms:
        seen[PATH.of(arm).name] = {"type": "line", "lineWidth": 0.001}
        if _feels(graph, arm):
            seen[BELIEF.of(arm).name] = {"axisScale": 0.03, "showCovariance": True}
    return {
        "followTf": (sensor_frame if _feels(graph, first) else tool_frame)(first),
        "followMode": "follow-position",
        "cameraState": {"distance": 0.4, "phi": 65, "thetaOffset": 45, "near": 0.01, "far": 100},
        "scene": {"transforms": {"axisScale": 0.03, "showLabel": False, "lineWidth": 0}},
        "topics": {topic: {"visible": True, **look} for topic, look in seen.items()},
    }


def _panels_of(graph: Graph, arm: str) -> list[tuple[str, str, dict[str, Any]]]:
    """What is shown of an arm: kind of panel, its name and settings, from top to bottom."""
    status = CONTROLLER_STATUS.of(arm).name
    states = {f"{status}.phase": "phase", f"{ARM_STATUS.of(arm).name}.mode": "arm"}
    panels = _images(graph, arm)
    if _feels(graph, arm):
        states[f"{PRESENCE.of(arm).name}.in_contact"] = "contact"
    panels.append(("StateTransitions", "states", {"paths": _paths(states), **_title(f"{arm}: phase")}))
    if _feels(graph, arm):
        for title, letters, first in CONTACT:
            fields = {f"{STATE.of(arm).name}.euler": "", f"{status}.reference": " ref."}
            curves = {
                f"{field}[{first + number}]": f"{letter}{what}"
                for field, what in fields.items()
                for number, letter in enumerate(letters)
            }
            panels.append(("Plot", f"contact{first}", _plot(curves, f"{arm}: {title}")))
    twist = {f"{status}.limited[{number}]": f"v{letter}" for number, letter in enumerate("xyz")}
    return [*panels, ("Plot", "twist", _plot(twist, f"{arm}: twist that was sent (m/s)"))]


def _images(graph: Graph, arm: str) -> list[tuple[str, str, dict[str, Any]]]:
    """The panel of an arm's images; tabs where the recording has them compressed, unlike the live graph."""
    shown = [("Image", topic.name.rpartition("/")[2], _image(topic)) for topic in _image_topics(graph, arm)]
    if len(shown) < 2:
        return shown
    tabs = [
        {"title": title, "layout": f"{kind}!{arm}_{name}"}
        for title, (kind, name, _) in zip(("live", "recorded"), shown, strict=True)
    ]
    return [("Tab", "images", {"activeTabIdx": 0, "tabs": tabs}), *shown]


def _image_topics(graph: Graph, arm: str) -> list[Topic]:
    """Where an arm's images are: in the live graph, and where else in its recording."""
    looks = any(plan.arm == arm and plan.role.task_type.needs_images for plan in graph.plans)
    seer = f"/{arm}/{'controller' if looks else 'estimator'}"
    topics = []
    for node in graph.nodes:
        if node.full_name == seer:
            packed = node.parameters.get("images.transport") == COMPRESSED
            topics.append((compressed(IMAGE) if packed else IMAGE).of(arm))
    recorded = [name for node in graph.nodes if node.name == RECORDER for name in node.parameters["images"]]
    return topics + [compressed(topic) for topic in topics if topic.name in recorded]


def _image(topic: Topic) -> dict[str, Any]:
    return {"imageMode": {"imageTopic": topic.name}}


def _plot(curves: dict[str, str], title: str) -> dict[str, Any]:
    return {"paths": _paths(curves), "legendDisplay": "left", "sidebarDimension": 75, **_title(title)}


def _paths(labels: dict[str, str]) -> list[dict[str, Any]]:
    """Message paths with what they are called."""
    return [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime"}
        for path, label in labels.items()
    ]


def _title(title: str) -> dict[str, str]:
    return {"lichtblickPanelTitle": title, "foxglovePanelTitle": title}
