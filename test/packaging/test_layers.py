"""Imports go one way; ROS stays at the edge."""

import ast
import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tactile_base.requirements import REQUIREMENTS

CORE = {"tactile_base", "tactile_geometry"}
CELL = CORE | {"tactile_scene"}
LIBRARIES = CELL | {"tactile_wire", "tactile_filter", "tactile_perception", "tactile_control", "tactile_sim"}

#: Package -> those that it may import, which come before it.
MAY_IMPORT = {
    "tactile_base": set(),
    "tactile_geometry": {"tactile_base"},
    "tactile_wire": CORE,
    "tactile_filter": CORE,
    "tactile_perception": CORE | {"tactile_filter"},
    "tactile_control": CORE | {"tactile_filter"},
    "tactile_scene": CORE,
    "tactile_drivers": CELL,
    "tactile_sim": CELL,
    "tactile_doubles": CELL | {"tactile_drivers", "tactile_sim"},
    "tactile_records": LIBRARIES,
    "tactile_ros": LIBRARIES | {"tactile_drivers", "tactile_doubles", "tactile_records"},
    "tactile_bringup": LIBRARIES | {"tactile_drivers", "tactile_doubles", "tactile_records", "tactile_ros"},
    "tactile_view": LIBRARIES | {"tactile_records", "tactile_ros", "tactile_bringup"},
}
PACKAGES = set(MAY_IMPORT)
EDGE = ("tactile_ros", "tactile_bringup/launching", "tactile_view/live")  # the folders that import ROS
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
    return path.relative_to(root).as_posix().startswith(EDGE)


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


def test_the_order_of_packages_has_no_circle():
    names = list(MAY_IMPORT)
    assert all(below <= set(names[:number]) for number, below in enumerate(MAY_IMPORT.values()))


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_import_only_what_stands_above_them(root: Path, package: str):
    offenders = {}
    for path in (root / package).rglob("*.py"):
        first_party = {name.split(".")[0] for name in imports(path)} & PACKAGES
        if others := first_party - MAY_IMPORT[package] - {package}:
            offenders[str(path.relative_to(root))] = sorted(others)
    assert not offenders


def test_no_files_import_each_other_in_a_circle(root: Path):
    """Imports for types alone count, too: who reads one of the files has to read all of them."""
    packages = drawing(root)
    modules = packages.modules_of(root)
    assert not packages.in_circles({name: packages.imported(path, modules) for name, path in modules.items()})


def test_a_circle_of_files_is_found(root: Path):
    graph = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set(), "e": {"e"}}
    assert drawing(root).in_circles(graph) == {"b", "c"}


def drawing(root: Path) -> Any:
    """The script that draws the packages."""
    spec = importlib.util.spec_from_file_location("draw_packages", root / "scripts/draw_packages.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_what_nodes_share_does_not_know_the_nodes(root: Path):
    offenders = [
        str(path.relative_to(root))
        for path in (root / "tactile_ros").glob("*.py")
        if any(name.startswith("tactile_ros.nodes") for name in imports(path))
    ]
    assert not offenders


def test_libraries_are_imported_where_there_is_no_ros(root: Path, tmp_path: Path):
    """Each module without ROS loads in a Python to which ROS is not installed."""
    absent = {name for name in OF_EXTRAS if importlib.util.find_spec(name) is None}
    modules = [
        name
        for name, path in drawing(root).modules_of(root).items()
        if not is_edge(path, root)
        and not {name.split(".")[0] for name in imports(path)} & (OPTIONAL | absent)
    ]
    blocked = sorted(
        ROS | {"std_msgs", "geometry_msgs", "sensor_msgs", "rcl_interfaces", "builtin_interfaces"}
    )
    script = (
        f"import importlib, sys\nsys.modules.update(dict.fromkeys({blocked!r}))\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]


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


#: What drivers of real arms, their doubles and the page import -> what pip calls it, in an extra.
OF_EXTRAS = dict.fromkeys(("dashboard_client", "rtde_control", "rtde_receive"), "ur-rtde") | {
    "franky": "franky-control",
    "franky_sim": "franky-sim",
    "foxglove": "foxglove-sdk",
}


def test_every_imported_library_is_required_by_the_package(root: Path):
    required, names = requirement_names(root), REQUIREMENTS | OF_EXTRAS
    missing = {name for name in third_party(root) if names.get(name, name) not in required}
    assert not missing, "add these to setup.cfg"


def test_what_is_looked_for_at_the_start_is_what_setup_cfg_requires(root: Path):
    assert set(REQUIREMENTS.values()) == requirement_names(root, with_training=False)


def test_what_package_xml_leaves_to_pip_is_named_there(root: Path):
    text = (root / "package.xml").read_text()
    keys = set(re.findall(r"<exec_depend>python3-(.*?)(?:-pip)?</exec_depend>", text))
    comment = re.search(r"Without a rosdep key, but on PyPI: (.*?)\.", text)
    assert comment is not None
    by_key = {"opencv-contrib-python-headless": "opencv", "pyyaml": "yaml"}
    names = {by_key.get(name, name) for name in REQUIREMENTS.values()}
    assert names - keys == set(comment[1].split(", "))


def requirement_names(root: Path, with_training: bool = True) -> set[str]:
    import configparser

    config = configparser.ConfigParser()
    config.read(root / "setup.cfg")
    extras = config["options.extras_require"]
    blocks = [config["options"]["install_requires"]]
    more = ("train", "cluster", "view", "parquet", "completion", "ur", "franka-sim")
    blocks += [extras[name] for name in more] if with_training else []
    return {re.split(r"[<>=\[ ]", line)[0] for block in blocks for line in block.splitlines() if line}


def test_every_imported_ros_package_is_a_dependency_in_package_xml(root: Path):
    import xml.etree.ElementTree as ElementTree

    tree = ElementTree.parse(root / "package.xml")
    declared = {element.text for kind in ("depend", "exec_depend") for element in tree.iter(kind)}
    used = {name.split(".")[0] for path in sources(root) for name in imports(path) if is_ros(name)}
    assert not used - declared
