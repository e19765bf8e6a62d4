"""Latency by stage and CPU by node of the real graph, each node in a process of its own.

    . scripts/env.sh && python bench/ros_latency.py --seconds 20

Latencies are from the exposure's stamp to the stage's output, cumulative. Without a goal the controller
answers each belief with a zero twist; what it costs to compute one is shown with `--follow`, which runs the
task.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import rclpy
from rclpy.action import ActionClient
from rclpy.signals import SignalHandlerOptions

from tactile_bringup.launching.environment import ros_environment
from tactile_bringup.launching.processes import ProcessGroup, tail
from tactile_msgs.action import RunTask
from tactile_msgs.msg import StageLatency
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_ros.discovery import use_dds_profile
from tactile_ros.run_nodes import make_executor

ARM = "arm"
STAGES = ("camera", "estimator", "filter", "controller")
NODES = {
    "sim": ("tactile_ros.nodes.sim_node", "/"),
    "estimator": ("tactile_ros.nodes.estimator_node", f"/{ARM}"),
    "filter": ("tactile_ros.nodes.filter_node", f"/{ARM}"),
    "controller": ("tactile_ros.nodes.controller_node", f"/{ARM}"),
}


def cpu_seconds(pid: int) -> float:
    """CPU time (s) that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def parameters(options: argparse.Namespace) -> dict[str, dict[str, str]]:
    """Parameters by node."""
    given: dict[str, dict[str, str]] = {"sim": {"scene": options.scene, "camera_rate": f"{options.rate:.1f}"}}
    given["estimator"] = {"images.rate": f"{options.rate:.1f}"}
    if options.model:
        given["estimator"]["model"] = options.model
    return given


def start(
    group: ProcessGroup, options: argparse.Namespace, folder: Path, variables: dict[str, str]
) -> dict[str, int]:
    """Start all nodes and wait until they are active; returns their process ids."""
    pids = {}
    for name, (module, namespace) in NODES.items():
        arguments = ["--ros-args", "-r", f"__ns:={namespace}"]
        for key, value in parameters(options).get(name, {}).items():
            arguments += ["-p", f"{key}:={value}"]
        command = [*options.prefix.split(), sys.executable, "-m", module, *arguments]
        pids[name] = group.start(name, command, variables, folder / f"{name}.log").process.pid
    end = time.monotonic() + 30.0
    while not all("active" in (folder / f"{name}.log").read_text() for name in NODES):
        group.check()
        if time.monotonic() > end:
            raise SystemExit("\n".join(tail(folder / f"{name}.log") for name in NODES))
        time.sleep(0.05)
    return pids


def measure(options: argparse.Namespace) -> None:
    """Run the graph for a while and print what was measured."""
    folder = Path(tempfile.mkdtemp(prefix="tactile_latency_"))
    base = {name: value for name, value in os.environ.items() if name != "ROS_DOMAIN_ID"}
    environment = ros_environment(folder, base)
    seconds: dict[str, dict[int, tuple[float, float]]] = {stage: {} for stage in STAGES}
    dropped = dict.fromkeys(STAGES, 0)

    def take(message: StageLatency) -> None:
        for times in zip(message.exposed, message.received, message.emitted, strict=True):
            exposed, received, emitted = map(ns_from_time, times)
            seconds[message.stage][exposed] = (emitted - exposed) * 1e-6, (emitted - received) * 1e-6
        dropped[message.stage] = message.dropped[-1]

    with ProcessGroup() as group:
        pids = start(group, options, folder, dict(environment.variables))
        use_dds_profile()
        rclpy.init(domain_id=environment.domain_id, signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node("latency_bench")
        executor = make_executor()
        executor.add_node(node)
        node.create_subscription(StageLatency, f"/{ARM}/latency", take, qos.LATENCY)

        def spin(duration: float) -> None:
            end = time.monotonic() + duration
            while time.monotonic() < end:
                executor.spin_once(timeout_sec=0.05)

        spin(2.0)
        if options.follow:
            client = ActionClient(node, RunTask, f"/{ARM}/run_task")
            client.wait_for_server(5.0)
            client.send_goal_async(
                RunTask.Goal(
                    task="surface_following", name="bench", goal="{direction_deg: 90.0, length: 1.0}"
                )
            )
            spin(4.0)
        for stage in STAGES:
            seconds[stage].clear()
        before, began = {name: cpu_seconds(pid) for name, pid in pids.items()}, time.monotonic()
        spin(options.seconds)
        elapsed = time.monotonic() - began
        cpu = {name: (cpu_seconds(pid) - before[name]) / elapsed * 100 for name, pid in pids.items()}
        group.check()
    rclpy.try_shutdown()
    report(seconds, dropped, cpu, options.rate * elapsed)
    if options.logs:
        for name in NODES:
            print(f"--- {name}\n{tail(folder / f'{name}.log')}")


def report(
    seconds: dict[str, dict[int, tuple[float, float]]],
    dropped: dict[str, int],
    cpu: dict[str, float],
    expected: float,
) -> None:
    """Print the table."""
    print(f"{'stage':12} {'frames':>7} {'of':>6} {'dropped':>8}   p50 ms   p90 ms   p99 ms   max ms  own p50")
    for stage in STAGES:
        rows = np.array(list(seconds[stage].values()))
        if not len(rows):
            print(f"{stage:12} nothing")
            continue
        p50, p90, p99, worst = np.percentile(rows[:, 0], [50, 90, 99, 100])
        own = np.median(rows[:, 1])
        counts = f"{len(rows):7d} {expected:6.0f} {dropped[stage]:8d}"
        print(f"{stage:12} {counts} {p50:8.2f} {p90:8.2f} {p99:8.2f} {worst:8.2f} {own:8.2f}")
    print("CPU of one core: " + ", ".join(f"{name} {percent:.0f} %" for name, percent in cpu.items()))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--rate", type=float, default=60.0, help="of the camera, Hz")
    parser.add_argument("--scene", default="ramp")
    parser.add_argument("--model", default="", help="ONNX file; the shipped one by default")
    parser.add_argument("--follow", action="store_true", help="run surface following while measuring")
    parser.add_argument("--prefix", default="", help="put before each node's command, as 'nice -n -10'")
    parser.add_argument("--logs", action="store_true", help="show the end of each node's log")
    measure(parser.parse_args())


if __name__ == "__main__":
    main()
