"""What `make` or colcon installs is complete: executables, data, C modules, messages."""

import importlib
import importlib.metadata
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

PACKAGES = [path.parent.name for path in sorted(Path(__file__).parents[2].glob("tactile_*/__init__.py"))]


@pytest.fixture(scope="module")
def prefix() -> Path:
    """Where the package is installed; these tests run on an installed package only."""
    ament_index = pytest.importorskip(
        "ament_index_python", reason="no ROS 2 in this environment: run `make test`"
    )
    return Path(ament_index.get_package_prefix("tactile_servoing"))


def entry_points() -> list[importlib.metadata.EntryPoint]:
    """Executables of the installed package."""
    return list(importlib.metadata.distribution("tactile_servoing").entry_points)


def test_every_executable_has_a_main_and_a_file_that_ros2_run_finds(prefix: Path):
    names = {point.name for point in entry_points()}
    assert {"tactile", "estimator", "filter", "controller", "sim", "recorder"} <= names
    for point in entry_points():
        assert callable(point.load()), point.value
        assert os.access(prefix / "lib" / "tactile_servoing" / point.name, os.X_OK)


def test_every_file_under_config_and_launch_is_installed(prefix: Path, root: Path):
    share = prefix / "share" / "tactile_servoing"
    sources = [path for path in (root / "config").rglob("*") if path.is_file()]
    sources += (root / "launch").glob("*.launch.py")
    assert sources
    for path in sources:
        installed = share / path.relative_to(root)
        assert installed.read_bytes() == path.read_bytes(), f"{installed} is not the one in the source tree"


def test_the_data_of_the_packages_is_installed(root: Path):
    """Models and other files that are neither code nor built from code."""
    import tactile_filter

    site_packages = Path(tactile_filter.__file__).parents[1]
    sources = {".py", ".pyc", ".c", ".h", ".so"}
    data = [
        path
        for package in PACKAGES
        for path in (root / package).rglob("*")
        if path.is_file() and path.suffix not in sources
    ]
    assert root / "tactile_perception" / "models" / "tactip_sim.onnx" in data
    for path in data:
        assert (site_packages / path.relative_to(root)).read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    "module",
    [
        "tactile_geometry._se3",
        "tactile_filter._fusion",
        "tactile_control._laws",
        "tactile_scene._native",
        "tactile_sim._contact",
    ],
)
def test_c_modules_are_built(module: str):
    loaded = importlib.import_module(module)
    assert loaded.__file__ is not None
    assert loaded.__file__.endswith(".so")


def test_package_xml_and_setup_cfg_name_the_same_package(root: Path):
    import configparser

    config = configparser.ConfigParser()
    config.read(root / "setup.cfg")
    tree = ElementTree.parse(root / "package.xml")
    messages = ElementTree.parse(root / "tactile_msgs" / "package.xml")
    for field in ("name", "version", "license"):
        assert tree.findtext(field) == config["metadata"][field]
    assert messages.findtext("version") == config["metadata"]["version"]


def test_the_command_on_the_path_prints_its_help(prefix: Path):
    command = [sys.executable, str(prefix / "bin" / "tactile"), "--help"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "launch" in result.stdout


def test_a_message_arrives_as_it_was_sent(prefix: Path):
    import numpy as np
    from rclpy.serialization import deserialize_message, serialize_message

    from tactile_msgs.msg import ContactState

    sent = ContactState(xi=np.arange(6.0), covariance=np.arange(36.0), nis=float("nan"), nis_dof=6)
    sent.flags = ContactState.GATED | ContactState.PREDICTED_ONLY
    sent.latency.nanosec, sent.inflation = 7, 1.5
    received = deserialize_message(serialize_message(sent), ContactState)
    assert np.array_equal(received.covariance, np.arange(36.0))
    assert np.isnan(received.nis)
    assert received.flags == sent.flags
    assert (received.latency, received.inflation) == (sent.latency, sent.inflation)


def interface_files(root: Path) -> list[Path]:
    return [path for kind in ("msg", "srv", "action") for path in (root / "tactile_msgs" / kind).iterdir()]


def test_every_interface_is_built_and_each_of_its_fields_is_explained(root: Path):
    """A field has a comment on its line, or stands below one, other fields between allowed."""
    import tactile_msgs.action
    import tactile_msgs.msg
    import tactile_msgs.srv

    for path in interface_files(root):
        assert hasattr(getattr(tactile_msgs, path.parent.name), path.stem)
        explained = False
        for line in path.read_text().splitlines():
            if not line.strip() or line.startswith("---"):
                explained = False
            elif line.startswith("#"):
                explained = True
            else:
                assert explained or "#" in line, f"{path.name}: '{line}' is not explained"


@pytest.mark.skipif(sys.version_info < (3, 11), reason="Python 3.10 starts `-m` in the current folder")
def test_a_node_started_in_a_folder_with_sources_imports_what_is_installed(prefix: Path, tmp_path: Path):
    shadow = tmp_path / "tactile_filter" / "__init__.py"
    shadow.parent.mkdir()
    shadow.write_text("raise ImportError('taken from the current folder')")
    subprocess.run([sys.executable, "-m", "tactile_base.settings"], cwd=tmp_path, check=True)
