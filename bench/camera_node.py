"""What the camera node makes of a USB camera's frames: python bench/camera_node.py [SECONDS] [RATE ...]

A double of a device (test/other_package/double_camera.py: JPEG frames of 640x480, stamped by CLOCK_MONOTONIC)
is driven by the driver `uvc` in the real camera node, and its images are received here. Printed, for each
rate: images received and lost; how far intervals between stamps stray from the period, which the device keeps
(standard deviation, 99 %, largest); and the age of an image when it is received.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from sensor_msgs.msg import Image

from tactile_base.topics import IMAGE
from tactile_bringup.launching.environment import ros_environment
from tactile_bringup.launching.processes import ProcessGroup
from tactile_ros import qos
from tactile_ros.discovery import use_dds_profile
from tactile_ros.message_bytes import header_of

ARM = "arm"
SCENE = """\
arms:
  arm:
    driver: external
    start: {{position: [0.0, 0.0, 0.032]}}
    sensor: {{camera: double_camera, camera_rate: {rate:g}}}
"""
WARM_UP = 2.0  # s


def measure(
    node: Any, executor: Any, variables: dict[str, str], folder: Path, rate: float, seconds: float
) -> str:
    """One rate; a row of the table."""
    (folder / "cell.yaml").write_text(SCENE.format(rate=rate))
    received: list[tuple[int, int]] = []

    def take(data: bytes) -> None:
        received.append((header_of(data)[0], time.time_ns()))

    subscription = node.create_subscription(Image, IMAGE.name, take, qos.IMAGE, raw=True)
    group = ProcessGroup(grace_s=10.0, kill_after_s=2.0)
    arguments = ["--ros-args", "-r", f"__ns:=/{ARM}", "-p", f"scene:={folder / 'cell.yaml'}"]
    command = [sys.executable, "-m", "tactile_ros.nodes.camera_node", *arguments]
    try:
        group.start("camera", command, variables, folder / "camera.log")
        while not received:
            group.check()
            executor.spin_once(timeout_sec=0.05)
        for duration in (WARM_UP, seconds):
            received.clear()
            end = time.monotonic() + duration
            while time.monotonic() < end:
                executor.spin_once(timeout_sec=0.05)
    finally:
        group.close()
        node.destroy_subscription(subscription)
    stamps, arrivals = np.array(received).T
    periods = np.diff(stamps) * 1e-9 * rate
    missing = int(np.maximum(np.rint(periods) - 1, 0).sum())
    stray = np.abs(periods - np.rint(periods)) / rate * 1e3
    ages = (arrivals - stamps) * 1e-6
    return (
        f"| {rate:g} | {len(received)} | {missing} | {stray.std():.3f} | {np.percentile(stray, 99):.3f} | "
        f"{stray.max():.3f} | {np.median(ages):.1f} | {np.percentile(ages, 99):.1f} |"
    )


def main() -> None:
    """Measure each rate of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seconds", type=float, nargs="?", default=10.0)
    parser.add_argument("rates", type=float, nargs="*", default=[60.0, 120.0])
    arguments = parser.parse_args()
    sys.path.insert(0, str(Path(__file__).parents[1] / "test"))
    from other_package import installed

    base = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
    use_dds_profile()
    with tempfile.TemporaryDirectory(prefix="tactile_camera_") as name:
        environment = ros_environment(Path(name), base)
        plugged_in = [*installed(Path(name)), base.get("PYTHONPATH", "")]
        variables = {**environment.variables, "PYTHONPATH": os.pathsep.join(plugged_in)}
        rclpy.init(domain_id=environment.domain_id)
        node = rclpy.create_node("bench", namespace=ARM)
        from rclpy.experimental import EventsExecutor

        executor = EventsExecutor()
        executor.add_node(node)
        print("| Hz | images | lost | strays by ms, std | 99 % | largest | age ms, median | 99 % |")
        print("| --- | --- | --- | --- | --- | --- | --- | --- |")
        for rate in arguments.rates:
            print(measure(node, executor, variables, Path(name), rate, arguments.seconds), flush=True)
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
