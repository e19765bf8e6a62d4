"""`tactile security FOLDER TASK`: which process of a task may say and hear what, for DDS security (SROS 2).

Writes policies.xml for `ros2 security`, which makes keys and signs permissions, and beside it what DDS checks
in the end: governance.xml, and permissions.xml of each enclave. Nothing is signed here. See SECURITY.md.
"""

from __future__ import annotations

import argparse
import os
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

from tactile_base.whole_file import check_folder
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import TASK_HELP
from tactile_bringup.graph import GraphOptions, load_graph
from tactile_bringup.permissions import enclaves, write_permissions
from tactile_scene.scene import EXTERNAL
from tactile_scene.scene_file import load_scene

YEARS = 10  # for which permissions are valid, as those of `ros2 security` are


def register(subparsers: Any) -> None:
    add = add_command(subparsers, "security", run, __doc__).add_argument
    add("folder", type=Path, metavar="FOLDER", help="a new folder")
    add("task", help=TASK_HELP)
    add("--scene", metavar="NAME", help="scene, or a scene file (default: the first that the task names)")
    add("--domain", type=int, metavar="N", help="ROS domain (default: ROS_DOMAIN_ID, else 0)")


def run(arguments: argparse.Namespace) -> int:
    folder: Path = arguments.folder
    domain = _domain(arguments.domain)
    check_folder(folder)
    if folder.exists() and any(folder.iterdir()):
        raise FileExistsError(f"{folder}: is not empty; name a new folder")
    # with all that a launch of the task can be asked for
    options = GraphOptions(record=folder / "bag", marker_view=True, object_belief=True)
    graph = load_graph(arguments.task, arguments.scene, options)
    scene = load_scene(str(graph.scene_file))
    now = datetime.now(timezone.utc)
    found = enclaves(graph, scene)
    folder.mkdir(parents=True, exist_ok=True)
    write_permissions(folder, found, domain, (now, now + timedelta(days=365 * YEARS)))
    keys = folder / "keystore"
    print(f"{folder}: {len(found)} enclaves of {graph.task} on {graph.scene}, ROS domain {domain}")
    for arm in scene.arms.values():
        if arm.driver == EXTERNAL:
            print(f"not in it: the nodes that move /{arm.name}")
        if arm.sensor is not None and arm.sensor.camera == EXTERNAL:
            print(f"not in it: the node that publishes the images of /{arm.name}")
    print(f"""With a ROS 2 install whose middleware has DDS security:
    export ROS_DOMAIN_ID={domain}
    ros2 security generate_artifacts -k {keys} -p {folder / "policies.xml"}
    export ROS_SECURITY_ENABLE=true ROS_SECURITY_STRATEGY=Enforce ROS_SECURITY_KEYSTORE={keys.absolute()}
By hand, as to stop all arms: ROS_SECURITY_ENCLAVE_OVERRIDE=/operator ros2 topic pub ...""")
    return 0


def _domain(given: int | None) -> int:
    text = str(given) if given is not None else os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdigit() or int(text) > 232:
        raise ValueError(f"ROS domain {text!r}: must be a number from 0 to 232 (101 on most Linux)")
    return int(text)
