"""What RViz shows of a graph: the task's packaged displays, for each of its arms and what it publishes."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import yaml

from tactile_base.config_paths import config_names, config_path
from tactile_base.topics import BELIEF, ROBOT_DESCRIPTION, link_frame
from tactile_bringup.graph import Graph

DEFAULT = "default"  # the displays of a task that has no file of its own
ARM = "arm"  # in the packaged file: each of the graph's arms


def write_view(graph: Graph, folder: Path) -> Path:
    """Write the graph's RViz configuration into a folder; returns its path."""
    own = graph.task if graph.task in config_names("rviz", ".rviz") else DEFAULT
    config = yaml.safe_load(config_path(f"rviz/{own}.rviz").read_text())
    manager = config["Visualization Manager"]
    manager["Displays"] = [shown for display in manager["Displays"] for shown in _shown(display, graph)]
    manager["Displays"] += _arms_shown(graph)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "view.rviz"
    path.write_text(yaml.safe_dump(config, sort_keys=False))
    return path


def _arms_shown(graph: Graph) -> list[dict[str, Any]]:
    arms = [arm for topic in graph.topics if (arm := ROBOT_DESCRIPTION.arm_of(topic.name)) is not None]
    return [
        {
            "Class": "rviz_default_plugins/RobotModel",
            "Name": f"Arm ({arm})",
            "Enabled": True,
            "Value": True,
            "Description Source": "Topic",
            "Description Topic": {
                "Value": ROBOT_DESCRIPTION.of(arm).name,
                "Reliability Policy": "Reliable",
                "Durability Policy": "Transient Local",
                "Depth": 1,
            },
            "TF Prefix": link_frame(arm, "").rstrip("/"),
            "Visual Enabled": True,
            "Collision Enabled": False,
        }
        for arm in arms
    ]


def _shown(display: dict[str, Any], graph: Graph) -> list[dict[str, Any]]:
    """A display of an arm's topic once an arm that feels; what only some graphs have is shown there."""
    topic = display.get("Topic", {}).get("Value", "")
    if topic.startswith(f"/{ARM}/"):
        feeling = [arm for arm in graph.arms if BELIEF.of(arm) in graph.topics]
        return [_of_arm(display, topic.removeprefix(f"/{ARM}/"), arm, feeling) for arm in feeling]
    if topic.startswith("/object/"):
        published = topic in {item.name for item in graph.topics}
        return [{**display, "Enabled": published, "Value": published}]
    return [display]


def _of_arm(display: dict[str, Any], topic: str, arm: str, arms: list[str]) -> dict[str, Any]:
    display = copy.deepcopy(display)
    display["Topic"]["Value"] = f"/{arm}/{topic}"
    if len(arms) > 1:
        display["Name"] += f" ({arm})"
    return display
