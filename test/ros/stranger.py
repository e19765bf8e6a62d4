"""A ROS process with no profile of ours that tries to be heard by the arm `arm`: python stranger.py SECONDS

It ends as soon as all of it was heard and the arm has stopped. Printed, as JSON: which nodes it sees, who
listens to what it says, whether it could send a goal, and the last mode that the arm told it.
"""

import json
import sys
import time

import rclpy
from rclpy.action import ActionClient
from std_msgs.msg import Bool

from tactile_msgs.action import RunTask
from tactile_msgs.msg import ArmCommand, ArmStatus


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("stranger")
    modes: list[int] = []
    node.create_subscription(ArmStatus, "/arm/arm/status", lambda status: modes.append(status.mode), 10)
    estop = node.create_publisher(Bool, "/estop", 10)
    command = node.create_publisher(ArmCommand, "/arm/command/request", 10)
    goals = ActionClient(node, RunTask, "/arm/run_task")
    end, listeners, goal = time.monotonic() + float(sys.argv[1]), [0, 0], False
    while time.monotonic() < end and not (goal and min(listeners) and modes[-1:] == [ArmStatus.ESTOP]):
        asked = ArmCommand(source="/stranger")
        asked.header.stamp = node.get_clock().now().to_msg()
        asked.header.frame_id = "arm/tactile_sensor"
        asked.twist = [0.0, 0.0, 0.01, 0.0, 0.0, 0.0]
        command.publish(asked)
        estop.publish(Bool(data=True))
        rclpy.spin_once(node, timeout_sec=0.05)
        counts = estop.get_subscription_count(), command.get_subscription_count()
        listeners = [max(pair) for pair in zip(listeners, counts, strict=True)]
        goal = goal or goals.server_is_ready()
    names = sorted(set(node.get_node_names()) - {"stranger"})
    found = {"nodes": names, "listeners": listeners, "goal": goal, "mode": modes[-1] if modes else None}
    print(json.dumps(found), flush=True)
    goals.destroy()
    node.destroy_node()
    rclpy.shutdown()


main()
