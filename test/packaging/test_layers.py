"""Imports go one way, bringup -> nodes -> {perception, control, drivers} -> filter; ROS stays at the edge."""

import ast
import sys
from pathlib import Path

import pytest

PACKAGES = {"tactile_filter", "tactile_perception", "tactile_control", "tactile_drivers", "tactile_bringup"}
# What each package may import of the others, its nodes aside.
BELOW = {
    "tactile_filter": set(),
    "tactile_perception": {"tactile_filter"},
    "tactile_control": {"tactile_filter"},
    "tactile_drivers": {"tactile_filter"},
    "tactile_bringup": PACKAGES,
}
ROS = {"rclpy", "tf2_ros", "launch", "launch_ros", "ament_index_python", "tactile_msgs", "tf2_msgs"}
OPTIONAL = {"torch", "onnx"}  # the extra `train`


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in the file it does."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            names.add(node.module)
    return names


def sources(root: Path) -> list[Path]:
    return [path for package in sorted(PACKAGES) for path in sorted((root / package).rglob("*.py"))]


def is_edge(path: Path, root: Path) -> bool:
    return path.name.endswith("_node.py") or path.relative_to(root).parts[0] == "tactile_bringup"


def is_ros(module: str) -> bool:
    top = module.split(".")[0]
    return top in ROS or top.endswith(("_msgs", "_srvs", "_interfaces"))


def test_libraries_do_not_import_ros(root: Path):
    offenders = {
        str(path.relative_to(root)): sorted(filter(is_ros, imports(path)))
        for path in sources(root)
        if not is_edge(path, root) and any(map(is_ros, imports(path)))
    }
    assert not offenders


@pytest.mark.parametrize("package", sorted(PACKAGES))
def test_packages_import_only_what_lies_below_them(root: Path, package: str):
    allowed = BELOW[package] | {package}
    offenders = {}
    for path in (root / package).rglob("*.py"):
        extra = {"tactile_bringup"} if path.name.endswith("_node.py") else set()
        first_party = {name.split(".")[0] for name in imports(path)} & PACKAGES
        if first_party - allowed - extra:
            offenders[str(path.relative_to(root))] = sorted(first_party - allowed - extra)
    assert not offenders


def test_nodes_take_nothing_of_bringup_but_what_they_share(root: Path):
    offenders = {
        str(path.relative_to(root)): sorted(bad)
        for path in sources(root)
        if path.name.endswith("_node.py") and path.relative_to(root).parts[0] != "tactile_bringup"
        if (
            bad := {
                n for n in imports(path) if n.startswith("tactile_bringup") and n.split(".")[1:2] != ["ros"]
            }
        )
    }
    assert not offenders


def test_what_nodes_share_imports_nothing_else_of_bringup(root: Path):
    offenders = {
        str(path.relative_to(root)): sorted(bad)
        for path in (root / "tactile_bringup" / "ros").rglob("*.py")
        if (
            bad := {
                name
                for name in imports(path)
                if name.startswith("tactile_bringup") and not name.startswith("tactile_bringup.ros")
            }
        )
    }
    assert not offenders


def test_pytorch_is_needed_for_training_only(root: Path):
    training = root / "tactile_perception" / "training"
    offenders = [
        str(path.relative_to(root))
        for path in sources(root)
        if training not in path.parents and {name.split(".")[0] for name in imports(path)} & OPTIONAL
    ]
    assert not offenders


def test_every_folder_with_modules_is_a_package(root: Path):
    missing = {path.parent for path in sources(root) if not (path.parent / "__init__.py").exists()}
    assert not missing, "a folder without __init__.py is not installed"


def third_party(root: Path) -> set[str]:
    names = {name.split(".")[0] for path in sources(root) for name in imports(path)}
    return {name for name in names if name not in sys.stdlib_module_names | PACKAGES and not is_ros(name)}


def test_every_imported_library_is_required_by_the_package(root: Path):
    distributions = {"cv2": "opencv-contrib-python-headless", "yaml": "pyyaml"}
    required = requirement_names(root)
    missing = {name for name in third_party(root) if distributions.get(name, name) not in required}
    assert not missing, "add these to setup.cfg"


def requirement_names(root: Path) -> set[str]:
    import configparser
    import re

    config = configparser.ConfigParser()
    config.read(root / "setup.cfg")
    extras = config["options.extras_require"]
    blocks = [config["options"]["install_requires"], extras["train"], extras["cluster"]]
    return {re.split(r"[<>=\[ ]", line)[0] for block in blocks for line in block.splitlines() if line}


def test_every_imported_ros_package_is_a_dependency_in_package_xml(root: Path):
    import xml.etree.ElementTree as ElementTree

    tree = ElementTree.parse(root / "package.xml")
    declared = {element.text for element in tree.iter("exec_depend")}
    used = {name.split(".")[0] for path in sources(root) for name in imports(path) if is_ros(name)}
    assert not used - declared
