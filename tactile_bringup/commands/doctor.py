"""`tactile doctor`: checks what the commands need, and says what to do where something is missing.

With --timing how well this machine keeps time: kernel, priorities, how late it wakes, from exposure to
twist with real nodes on the simulated cell, which takes half a minute; with --scene also camera and arm,
which does not move.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tactile_base.requirements import REQUIREMENTS
from tactile_bringup.commands.changes import add_command
from tactile_bringup.commands.launch import add_time_options, time_options

if TYPE_CHECKING:
    from tactile_bringup.findings import Finding

PACKAGES = ("tactile_msgs", "sensor_msgs", "geometry_msgs", "tf2_msgs", "diagnostic_msgs", "lifecycle_msgs")
COMPILED = ("tactile_geometry._se3", "tactile_filter._fusion", "tactile_sim._contact")
SHARED_MEMORY_NEEDED = 64 * 1024 * 1024  # bytes: images and port segments of two arms


class Missing(RuntimeError):
    """What is missing, and what to do about it."""


def register(subparsers: Any) -> None:
    parser = add_command(subparsers, "doctor", run, __doc__, wrong=(RuntimeError,))
    add = parser.add_argument
    add("--timing", action="store_true", help="how well this machine keeps time")
    add("--scene", default="", metavar="NAME", help="with --timing: whose camera and arm are looked at, too")
    add("--arm", default="", metavar="NAME", help="which of its arms (default: the only one)")
    add_time_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run all checks; returns 0 when all passed, else 1."""
    return _timing(arguments) if arguments.timing else _all_there()


def _timing(arguments: argparse.Namespace) -> int:
    from tactile_bringup.findings import show
    from tactile_bringup.staged_arm import arm_of
    from tactile_bringup.timing import (
        check_arm_link,
        check_camera,
        check_exposure_to_twist,
        check_machine,
        check_wakeups,
    )
    from tactile_scene.scene_file import load_scene

    arm = arm_of(load_scene(arguments.scene), arguments.arm) if arguments.scene else None

    def findings() -> Iterator[Finding]:
        yield from check_machine()
        yield check_wakeups()
        if arm is not None:
            yield from check_camera(arm)
            yield from check_arm_link(arm)
        yield check_exposure_to_twist(time_options(arguments))

    return show(findings())


def _all_there() -> int:
    failed = 0
    for name, check in CHECKS.items():
        try:
            print(f"ok       {name}: {check()}")
        except (Missing, ImportError, LookupError, OSError, RuntimeError, ValueError) as problem:
            failed += 1
            print(f"MISSING  {name}: {'; '.join([str(problem), *HINTS.get(name, ())])}")
    print(f"{failed} of {len(CHECKS)} checks failed" if failed else "all is there")
    return 1 if failed else 0


def _python() -> str:
    if not (3, 10) <= sys.version_info[:2] <= (3, 13):
        raise Missing(f"{sys.version.split()[0]}: must be 3.10 to 3.13 (make PYTHON=python3.12)")
    return f"{sys.version.split()[0]} at {sys.executable}"


def _sources() -> str:
    """Whether what is installed is what the sources beside it say, where `make` has installed it."""
    folders = Path(__file__).resolve().parents
    root = next((folder.parent for folder in folders if folder.name == "install"), Path())
    build = root / "scripts" / "build.sh"
    if not build.is_file():
        return "installed without a checkout beside it"
    if subprocess.run([build, "--check"], capture_output=True, check=False).returncode:
        raise Missing(f"the sources in {root} are not what is installed: type `make` there")
    return f"installed as the sources in {root} say"


def _ros() -> str:
    from tactile_bringup.launching.environment import middleware
    from tactile_bringup.launching.start_check import check_middleware

    check_middleware()
    return f"{os.environ.get('ROS_DISTRO', 'unknown distribution')}, {middleware()}"


def _imported(*modules: str) -> str:
    for module in modules:
        importlib.import_module(module)
    return ", ".join(modules)


def _definitions() -> str:
    from tactile_wire.message_definitions import message_definition

    message_definition("tactile_msgs/msg/ContactState")
    return "of tactile_msgs, for bags"


def _configuration() -> str:
    from tactile_base.config_paths import config_folder, config_names

    return f"{config_folder()}: scenes {', '.join(config_names('scenes'))}"


def _model() -> str:
    from tactile_perception.estimating.estimator import Estimator

    return str(Estimator().path)


def _shared_memory() -> str:
    from tactile_bringup.launching.shared_memory import SHARED_MEMORY, orphans

    if not os.access(SHARED_MEMORY, os.W_OK):
        raise Missing(f"{SHARED_MEMORY} cannot be written: images would go through UDP, ten times slower")
    status = os.statvfs(SHARED_MEMORY)
    free = status.f_bavail * status.f_frsize
    if free < SHARED_MEMORY_NEEDED:
        raise Missing(f"{SHARED_MEMORY}: {free >> 20} MiB free, need {SHARED_MEMORY_NEEDED >> 20} MiB")
    left = orphans()
    return f"{SHARED_MEMORY}, {free >> 20} MiB free" + (f", {len(left)} files of dead nodes" if left else "")


def _domain() -> str:
    from tactile_bringup.launching.environment import ros_environment

    environment = ros_environment(Path())
    chosen = "would be chosen" if environment.domain_chosen else "as set"
    return f"{environment.domain_id} ({chosen}), discovery {environment.discovery}"


def _security() -> str:
    """What becomes of a node that is to use keys and finds none; only the middleware itself can tell."""
    from tactile_bringup.launching.environment import start_without_keys

    wanted = os.environ.get("ROS_SECURITY_ENABLE") == "true"
    if wanted and os.environ.get("ROS_SECURITY_STRATEGY") != "Enforce":
        raise Missing("ROS_SECURITY_STRATEGY is not Enforce: a node without keys would run open to all")
    said = start_without_keys()
    if not said:
        raise Missing("ROS_SECURITY_ENABLE=true is passed over: a node without keys was let in (SECURITY.md)")
    if "security files" in said:
        return "there; a node without its keys does not start"
    why = "this middleware is built without it" if "security libraries" in said else said.splitlines()[-1]
    closed = f"{why}; nodes with ROS_SECURITY_ENABLE=true do not start"
    if wanted:
        raise Missing(f"{closed}; SECURITY.md says what has it")
    return f"none: {closed} (SECURITY.md)"


def _limits() -> str:
    from tactile_base.process_limits import GRAPH, MIB, address_space, require

    require(GRAPH, "a node")
    return f"{GRAPH.files} open files, {address_space(GRAPH) // MIB} MiB of address space may be had"


CHECKS: dict[str, Callable[[], str]] = {
    "Python": _python,
    "Python packages": lambda: ", ".join(REQUIREMENTS.values()),  # `tactile` itself has looked for them
    "sources": _sources,
    "ROS 2": _ros,
    "messages": lambda: _imported(*(f"{package}.msg" for package in PACKAGES)),
    "message definitions": _definitions,
    "compiled modules": lambda: _imported(*COMPILED),
    "configuration": _configuration,
    "model": _model,
    "shared memory": _shared_memory,
    "ROS domain": _domain,
    "DDS security": _security,
    "limits": _limits,
}
#: What to do where a check fails, besides what the failure itself says.
HINTS = {
    "ROS 2": ["source a ROS 2 install or scripts/env.sh (after `make`)"],
    "messages": ["build the workspace (make) and source it (scripts/env.sh)"],
    "message definitions": ["bags could not be recorded"],
    "compiled modules": ["build with `make`"],
}
