"""How many images of somebody else's node arrive: python bench/plain_camera.py [SECONDS]

A node in plain rclpy (test/ros/plain_camera.py) publishes 640x480 at 60 Hz, as mono8 and as bgr8, without a
profile of Fast DDS, whose shared memory is then 512 kB, and with `config/dds/this_host.xml`, 4 MB. They are
received as the estimator does it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import rclpy
from sensor_msgs.msg import Image

from tactile_base.config_paths import config_path
from tactile_base.topics import IMAGE
from tactile_bringup.launching.environment import ros_environment
from tactile_ros import qos
from tactile_ros.discovery import PROFILE_VARIABLES, THIS_HOST, use_dds_profile

CAMERA = Path(__file__).parents[1] / "test/ros/plain_camera.py"
RATE = 60.0  # Hz


def measure(encoding: str, reliability: str, profile: str, variables: dict[str, str], seconds: float) -> str:
    """One camera; a row of the table."""
    from rclpy.experimental import EventsExecutor

    context = rclpy.Context()
    rclpy.init(context=context, domain_id=int(variables["ROS_DOMAIN_ID"]))
    node = rclpy.create_node("bench", context=context, namespace="arm")
    executor = EventsExecutor(context=context)
    executor.add_node(node)
    received: list[int] = []
    node.create_subscription(Image, IMAGE.name, lambda data: received.append(len(data)), qos.IMAGE, raw=True)
    given = {PROFILE_VARIABLES[0]: str(config_path(THIS_HOST))} if profile else {}
    command = [sys.executable, str(CAMERA), encoding, str(RATE), str(seconds), reliability]
    camera = subprocess.Popen(command, env={**variables, **given}, stdout=subprocess.PIPE, text=True)
    while camera.poll() is None:
        executor.spin_once(timeout_sec=0.05)
    sent = int(camera.communicate()[0])
    executor.remove_node(node)
    node.destroy_node()
    context.shutdown()
    return f"| {encoding} | {reliability} | {profile or 'none'} | {sent} | {sent - len(received)} |"


def main() -> None:
    """Print a row for each encoding, reliability and profile."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=10.0)
    seconds = parser.parse_args().seconds
    base = {n: v for n, v in os.environ.items() if n not in (*PROFILE_VARIABLES, "ROS_DOMAIN_ID")}
    use_dds_profile()
    print("| encoding | publisher | profile | sent | lost |\n| --- | --- | --- | --- | --- |")
    with tempfile.TemporaryDirectory(prefix="tactile_plain_camera_") as name:
        for encoding in ("mono8", "bgr8"):
            for reliability in ("best_effort", "reliable"):
                for profile in ("", Path(THIS_HOST).name):
                    variables = dict(ros_environment(Path(name), base).variables)
                    print(measure(encoding, reliability, profile, variables, seconds), flush=True)
                    time.sleep(0.5)


if __name__ == "__main__":
    main()
