"""The running graph under messages, parameters and goals that nobody meant, by a fixed seed.

A minute of it by default; FUZZ_SECONDS=600 for ten, and FUZZ_SEED for others::

    FUZZ_SECONDS=600 scripts/test.sh -s -o faulthandler_timeout=0 test/ros/test_fuzz.py
"""

import os
import struct
import time
from collections import Counter

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from rcl_interfaces.msg import ParameterEvent
from rcl_interfaces.srv import ListParameters
from rclpy.subscription import RCLError
from sensor_msgs.msg import Image
from std_msgs.msg import Bool
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from tactile_base.config_paths import config_path
from tactile_bringup.graph import GraphOptions, load_graph
from tactile_msgs.action import RunTask
from tactile_msgs.msg import (
    ArmCommand,
    ArmStatus,
    ContactPresence,
    ContactState,
    ContactTruth,
    ControllerStatus,
    StageLatency,
)
from tactile_ros import qos
from tactile_ros.conversions import ns_from_time
from tactile_ros.task_messages import goal_message

SECONDS = float(os.environ.get("FUZZ_SECONDS", "60"))
SEED = int(os.environ.get("FUZZ_SEED", "0"))
PERIOD = 0.01  # s between two messages that nobody meant
QUIET, BURST = 8.0, 3.0  # s; at most until the task follows the surface, and of messages that nobody meant
PROTECTIVE_DEPTH, LARGEST_SPEED = 0.010, 0.1
GROWTH = 60e6  # bytes that a process may grow by after the first third, when all its caches are full

TOPICS = (
    ("/tf", TFMessage, qos.TF),
    ("/tf_static", TFMessage, qos.TF_STATIC),
    ("/parameter_events", ParameterEvent, qos.STATE),
    ("tactile/image", Image, qos.IMAGE),
    ("contact/presence", ContactPresence, qos.STATE),
    ("contact/estimate", PoseWithCovarianceStamped, qos.STATE),
    ("contact/belief", PoseWithCovarianceStamped, qos.STATE),
    ("contact/state", ContactState, qos.STATE),
    ("command/request", ArmCommand, qos.COMMAND),
    ("arm/status", ArmStatus, qos.STATE),
    ("controller/status", ControllerStatus, qos.STATE),
    ("latency", StageLatency, qos.LATENCY),
    ("/estop", Bool, qos.STATE),
)
DOUBLES = (float("nan"), float("inf"), -float("inf"), 1e308, -1e300, 1e-300, 0.0, -1.0, 10.0, 0.05)
LENGTHS = (0, 1, 0x7FFFFFFF, 0xFFFFFFFF, 0x20000000, 65536)
TEXTS = ("", "{", "{length: .nan}", "{length: -1}", "&a [*a]", "{direction_deg: [1]}", "\x00", "ä" * 1000)


def flip(data, rng):
    for _ in range(int(rng.integers(1, 9))):
        data[int(rng.integers(len(data)))] ^= 1 << int(rng.integers(8))
    return data


def cut(data, rng):
    return data[: int(rng.integers(len(data)))]


def extend(data, rng):
    return data + bytes(rng.integers(0, 256, int(rng.integers(1, 200)), dtype=np.uint8))


def other_length(data, rng):
    place = 4 * int(rng.integers(1, max(2, min(len(data), 200) // 4)))
    data[place : place + 4] = struct.pack("<I", LENGTHS[int(rng.integers(len(LENGTHS)))])
    return data


def other_double(data, rng):
    place = 4 + 8 * int(rng.integers(0, max(1, (min(len(data), 600) - 12) // 8)))
    data[place : place + 8] = struct.pack("<d", DOUBLES[int(rng.integers(len(DOUBLES)))])
    return data


def other_stamp(data, rng):
    shift = int(rng.choice([-1000, -1, 1, 10, 100, 2**30]))
    if len(data) >= 8:
        data[4:8] = struct.pack("<i", (struct.unpack("<i", data[4:8])[0] + shift) % 2**31)
    return data


def noise(data, rng):
    return bytearray(rng.integers(0, 256, int(rng.integers(0, 400)), dtype=np.uint8))


def again(data, rng):
    return data


MUTATIONS = (flip, flip, cut, extend, other_length, other_double, other_double, other_stamp, noise, again)


class Fuzzed:
    """A graph that follows the ramp again and again, and what is sent into it."""

    def __init__(self, graph, folder) -> None:
        self.graph, self.rng = graph, np.random.default_rng(SEED)
        scene = folder / "ramp.yaml"
        scene.write_text(
            config_path("scenes/ramp.yaml").read_text().replace("0.062]", "0.053]")
        )  # 3 mm above
        built = load_graph("surface_following", str(scene), GraphOptions(rate=30.0, record=folder / "bag"))
        self.plan = built.plans[0]
        for node in built.nodes:
            file = folder / f"{node.file_stem}.yaml"
            file.write_text(node.parameter_text())
            graph.processes.start(node.name, node.command(file), graph.variables, graph.log(node.name))
        for node in built.nodes:
            graph.wait_until_active(node.name)
        self.truths = graph.collect(ContactTruth, "sim/truth")
        self.arms = graph.collect(ArmStatus, "arm/status")
        self.phases = graph.collect(ControllerStatus, "controller/status")
        self.targets: list[str] = []  # topics that are sent to now
        self.until = 0.0
        self.client = graph.action(RunTask, "run_task")
        self.samples: dict[str, list[bytes]] = {name: [] for name, _, _ in TOPICS}
        self.outs = {name: graph.node.create_publisher(kind, name, profile) for name, kind, profile in TOPICS}
        self.samples["/estop"] = [b"\x00\x01\x00\x00\x01", b"\x00\x01\x00\x00\x00"]
        for name, kind, profile in TOPICS:
            keep = self.samples[name].append
            graph.node.create_subscription(kind, name, lambda data, keep=keep: keep(data), profile, raw=True)
        self.parameters = {node: self._parameters(node) for node in ("controller", "filter", "estimator")}
        self.sent: Counter[str] = Counter()
        self.goal = self.result = None
        self.done: Counter[str] = Counter()

    def _parameters(self, node):
        names = self.graph.call(ListParameters, f"{node}/list_parameters", ListParameters.Request())
        return [name for name in names.result.names if "." in name]

    def aim(self) -> None:
        """Leave the task alone until it follows the surface, then send to two topics for a while."""
        now = time.monotonic()
        if self.targets and now > self.until:
            self.targets, self.until = [], now + QUIET
        elif not self.targets and (now > self.until or self.phases[-1].phase == "follow"):
            chosen = self.rng.choice(len(TOPICS), 2, replace=False)
            self.targets, self.until = [TOPICS[int(k)][0] for k in chosen], now + BURST

    def message(self) -> None:
        self.aim()
        if not self.targets:
            return
        name = str(self.rng.choice(self.targets))
        if name == "/estop" and self.rng.random() < 0.9:  # else it would hardly move
            return
        if not (known := self.samples[name]):
            return
        del known[:-20]
        data = bytearray(known[int(self.rng.integers(len(known)))])
        mutation = MUTATIONS[int(self.rng.integers(len(MUTATIONS)))]
        if not data:
            return
        try:
            self.outs[name].publish(bytes(mutation(data, self.rng)))
            self.sent[name] += 1
        except RCLError:  # longer than any message of a type of fixed size
            self.sent["refused by the middleware"] += 1

    def parameter(self) -> None:
        node = str(self.rng.choice(list(self.parameters)))
        name = str(self.rng.choice(self.parameters[node]))
        value = self.rng.choice([1e308, -1.0, 0.0, float("nan"), float("inf"), 3.2])
        before = self.graph.get_parameter(node, name)
        if isinstance(before, float):
            answer = self.graph.set_parameter(node, name, float(value))
            self.sent["parameters refused" if not answer.successful else "parameters"] += 1
            self.graph.set_parameter(node, name, before)

    def task(self) -> None:
        """Keep a goal running; whatever stopped the arm is reset first."""
        if self.goal is None:
            if self.arms and self.arms[-1].mode in (ArmStatus.ESTOP, ArmStatus.FAULT):
                self.graph.call(Trigger, "arm/reset", Trigger.Request())
                self.sent["resets"] += 1
            goal = goal_message(self.plan.role.task, self.plan.goals[0])
            if self.rng.random() < 0.1:
                goal.goal = str(self.rng.choice(TEXTS))
            self.goal = self.client.send_goal_async(goal)
        elif self.result is None and self.goal.done():
            handle = self.goal.result()
            self.result = handle.get_result_async() if handle.accepted else None
            self.goal = self.goal if handle.accepted else None
        elif self.result is not None and self.result.done():
            self.done["succeeded" if self.result.result().result.success else "failed"] += 1
            self.goal = self.result = None

    def memory(self) -> dict[str, float]:
        """Resident bytes of each process."""
        page = os.sysconf("SC_PAGE_SIZE")
        return {
            name: page * int(open(f"/proc/{child.process.pid}/statm").read().split()[1])
            for name, child in self.graph.processes.children.items()
        }

    def run(self, seconds: float) -> None:
        end, number = time.monotonic() + seconds, 0
        while time.monotonic() < end:
            self.message()
            if number % 20 == 0:
                self.task()
            if number % 150 == 75:
                self.parameter()
            number += 1
            self.graph.spin(PERIOD)
            for name, child in self.graph.processes.children.items():
                assert child.process.poll() is None, (
                    f"{name} has ended:\n{self.graph.log(name).read_text()[-3000:]}"
                )


@pytest.mark.timeout(300 + 3 * SECONDS)
def test_no_process_ends_and_no_limit_is_passed_whatever_is_sent_into_the_graph(graph, tmp_path):
    fuzzed = Fuzzed(graph, tmp_path)
    fuzzed.run(SECONDS / 3)
    before = fuzzed.memory()
    fuzzed.run(SECONDS * 2 / 3)
    grown = {name: size - before[name] for name, size in fuzzed.memory().items()}
    print(f"\nsent {dict(fuzzed.sent)}, goals {dict(fuzzed.done)}, grown by (MB)",
          {name: round(size / 1e6, 1) for name, size in grown.items()})  # fmt: skip
    assert sum(fuzzed.sent.values()) > 5 * SECONDS
    assert max(grown.values()) < GROWTH, grown
    depths = [truth.depth for truth in fuzzed.truths]
    assert 0.001 < max(depths) <= PROTECTIVE_DEPTH + 1e-4
    where = np.array([[t.pose.position.x, t.pose.position.y, t.pose.position.z] for t in fuzzed.truths])
    stamps = np.array([ns_from_time(t.header.stamp) for t in fuzzed.truths])
    elapsed = np.diff(stamps) * 1e-9
    assert (elapsed > 0).all()
    speeds = np.linalg.norm(np.diff(where, axis=0), axis=1) / elapsed
    print(f"deepest {max(depths) * 1e3:.2f} mm, fastest {speeds.max() * 1e3:.1f} mm/s")
    assert speeds.max() <= LARGEST_SPEED * np.sqrt(
        3
    )  # each axis keeps the limit while one command follows another
