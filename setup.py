"""The ROS 2 package `tactile_servoing`: Python packages, C modules, executables, launch files, configuration.

Names, versions and requirements stand in setup.cfg.
"""

import os
import sys
from glob import glob
from pathlib import Path

from setuptools import Extension, find_packages, setup

PACKAGE = "tactile_servoing"

GEOMETRY = "tactile_geometry/_csrc"  # its headers are for all modules, with the functions of se3.c

# Extension module -> its C sources
C_MODULES = {
    "tactile_geometry._se3": [f"{GEOMETRY}/*.c"],
    "tactile_filter._fusion": ["tactile_filter/_csrc/*.c", f"{GEOMETRY}/se3.c"],
    "tactile_scene._native": ["tactile_scene/_csrc/*.c"],
    "tactile_sim._contact": ["tactile_sim/_csrc/*.c", f"{GEOMETRY}/se3.c"],
    "tactile_control._laws": ["tactile_control/_csrc/*.c"],
}

# Executables of `ros2 run tactile_servoing NAME` -> the module whose main() they call.
NODES = {
    "estimator": "tactile_ros.nodes.estimator_node",
    "marker_view": "tactile_ros.nodes.marker_view_node",
    "filter": "tactile_ros.nodes.filter_node",
    "object": "tactile_ros.nodes.object_node",
    "controller": "tactile_ros.nodes.controller_node",
    "sim": "tactile_ros.nodes.sim_node",
    "arm": "tactile_ros.nodes.arm_node",
    "camera": "tactile_ros.nodes.camera_node",
    "recorder": "tactile_ros.nodes.recorder_node",
}


def require_messages() -> None:
    """End unless the messages are built, whose package lies in this one's folder."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    if not any((Path(prefix) / "share/tactile_msgs/package.xml").exists() for prefix in prefixes if prefix):
        sys.exit(
            f"{PACKAGE}: tactile_msgs is not built: colcon looks for no packages inside of another one. "
            f"In the workspace type:\n    colcon build --base-paths src {Path.cwd() / 'tactile_msgs'}"
        )


def extension(name: str, patterns: list[str]) -> Extension:
    """A C module without fast-math and without -march: what an instruction set adds is chosen at runtime."""
    import numpy

    folder = str(Path(patterns[0]).parent)
    return Extension(
        name,
        sources=sorted(path for pattern in patterns for path in glob(pattern)),
        depends=sorted(glob(f"{folder}/*.h") + glob(f"{GEOMETRY}/*.h")),
        include_dirs=[numpy.get_include(), folder, GEOMETRY],
        define_macros=[("NPY_NO_DEPRECATED_API", "NPY_1_7_API_VERSION")],
        # Python's own -fwrapv would keep loops over x + 1 with an int x from being vectorized
        extra_compile_args=["-O3", "-std=c99", "-Wall", "-Wextra", "-ffp-contract=off", "-fno-wrapv"],
    )


def shared_files(folder: str, pattern: str) -> list[tuple[str, list[str]]]:
    """Install the matching files under `folder`, in the same tree, into the package's share folder."""
    by_folder: dict[Path, list[str]] = {}
    for path in sorted(Path(folder).rglob(pattern)):
        if path.is_file():
            by_folder.setdefault(path.parent, []).append(str(path))
    return [(f"share/{PACKAGE}/{parent}", files) for parent, files in by_folder.items()]


if {"install", "develop"} & set(sys.argv):  # as colcon does; pip builds a wheel, which can do without ROS
    require_messages()

setup(
    packages=find_packages(include=["tactile_*"], exclude=["tactile_msgs", "tactile_msgs.*"]),
    package_data={
        "": ["py.typed", "*.pyi", "*.yaml", "data/*", "models/*", "templates/*.in", "templates/*/*.in"]
    },
    ext_modules=[extension(name, patterns) for name, patterns in C_MODULES.items()],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        ("bin", ["scripts/tactile"]),
        *shared_files("launch", "*.launch.py"),
        *shared_files("config", "*"),
        *shared_files("tactile_msgs", "*.msg"),  # for bags, also where the messages are not built
        *shared_files("tactile_msgs", "*.action"),
    ],
    entry_points={
        "console_scripts": [
            "tactile = tactile_bringup.cli:main",
            *(f"{name} = {module}:main" for name, module in NODES.items()),
        ],
    },
)
