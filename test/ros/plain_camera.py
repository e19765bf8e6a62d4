"""A camera's node of somebody else, in plain rclpy: python plain_camera.py ENCODING HZ SECONDS RELIABILITY

It publishes 640x480 on /arm/tactile/image, "reliable" or "best_effort", and prints how many it has sent.
"""

import sys
import time

import numpy as np
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

CHANNELS = {"mono8": 1, "bgr8": 3}


def main() -> None:
    encoding, rate, seconds = sys.argv[1], float(sys.argv[2]), float(sys.argv[3])
    rclpy.init()
    node = rclpy.create_node("plain_camera")
    profile = QoSProfile(depth=10, reliability=ReliabilityPolicy[sys.argv[4].upper()])
    publisher = node.create_publisher(Image, "/arm/tactile/image", profile)
    pixels = np.random.default_rng(1).integers(0, 255, 480 * 640 * CHANNELS[encoding], dtype=np.uint8)
    image = Image(height=480, width=640, encoding=encoding, step=640 * CHANNELS[encoding])
    image.data = pixels.tobytes()
    while publisher.get_subscription_count() == 0:
        time.sleep(0.01)
    sent, start = 0, time.monotonic()
    while time.monotonic() < start + seconds:
        image.header.stamp = node.get_clock().now().to_msg()
        publisher.publish(image)
        sent += 1
        time.sleep(max(0.0, start + sent / rate - time.monotonic()))
    print(sent, flush=True)
    time.sleep(0.5)  # what was sent last still arrives
    node.destroy_node()
    rclpy.shutdown()


main()
