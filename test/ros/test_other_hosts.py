"""Nodes speak with this host alone unless they are asked to: a network namespace stands for another host."""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tactile_base.config_paths import config_path
from tactile_bringup.launching import shared_memory
from tactile_bringup.launching.environment import ros_environment
from tactile_bringup.launching.processes import ProcessGroup, tail
from tactile_msgs.msg import ArmStatus

IP = shutil.which("ip", path=f"{os.environ['PATH']}:/usr/sbin:/sbin")
ROBOT, STRANGER = "10.213.77.1", "10.213.77.2"
HERE = Path(__file__).parent
ENTRY = "import sys, time; import rclpy; rclpy.init(); n = rclpy.create_node('plain'); time.sleep(600)"
RANGE, PEERS = "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"
EPHEMERAL = 32768  # from here on ports of sockets that only send; those of RTPS in our domains are below
PATIENCE = 60.0  # s
ATTEMPT = 6.0  # s for which a stranger tries; others are heard in less than one


def ip(*words: str, fine: bool = True) -> str:
    done = subprocess.run([str(IP), *words], capture_output=True, text=True)
    if done.returncode and fine:
        pytest.skip(f"no network namespaces for this user: ip {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


@pytest.fixture(scope="module")
def hosts() -> Iterator[SimpleNamespace]:
    """Two namespaces joined by a cable; each value is what a command begins with that runs in it."""
    if IP is None:
        pytest.skip("no network namespaces: there is no `ip` (iproute2)")
    number = os.getpid()
    robot, other = f"tactile-{number}-robot", f"tactile-{number}-other"
    try:
        for name in (robot, other):
            ip("netns", "add", name)
        ends = ("name", f"t{number}a", "netns", robot, "type", "veth", "peer", "name", f"t{number}b")
        ip("link", "add", *ends, "netns", other)
        for name, end, address in ((robot, "a", ROBOT), (other, "b", STRANGER)):
            ip("-n", name, "address", "add", f"{address}/24", "dev", f"t{number}{end}")
            for device in ("lo", f"t{number}{end}"):
                ip("-n", name, "link", "set", device, "up")
        inside = {name: [str(IP), "netns", "exec", name] for name in (robot, other)}
        # another host has shared memory of its own
        apart = ["unshare", "-m", "sh", "-c", 'mount -t tmpfs tmpfs /dev/shm && exec "$0" "$@"']
        yield SimpleNamespace(robot=inside[robot], other=[*inside[other], *apart])
    finally:
        for name in (robot, other):
            ip("netns", "delete", name, fine=False)


class Robot:
    """A simulated arm and its controller on the host `robot`, beside a plain node that was there before."""

    def __init__(self, folder: Path, prefix: list[str], variables: dict[str, str]) -> None:
        self.folder, self.prefix, self.variables = folder, prefix, variables
        self.started_ns = time.time_ns()
        self.processes = ProcessGroup(grace_s=20.0, kill_after_s=1.0)
        plain = {**variables, RANGE: "SUBNET"}
        self.processes.start("plain", [*prefix, sys.executable, "-c", ENTRY], plain, folder / "plain.log")
        scene = config_path("scenes/ramp.yaml").read_text()
        ideal = "simulation:\n  sensors: {arm: {fidelity: ideal}}\nbodies:"
        (folder / "scene.yaml").write_text(scene.replace("bodies:", ideal))
        self.start("sim", "/", f"scene:={folder / 'scene.yaml'}")
        self.start("controller", "/arm")

    def start(self, name: str, namespace: str, *parameters: str) -> None:
        command = [sys.executable, "-m", f"tactile_ros.nodes.{name}_node", "--ros-args", "-r"]
        given = [word for parameter in parameters for word in ("-p", parameter)]
        log = self.folder / f"{name}.log"
        words = [*self.prefix, *command, f"__ns:={namespace}", *given]
        process = self.processes.start(name, words, self.variables, log).process
        end = time.monotonic() + PATIENCE
        while "active" not in log.read_text() and process.poll() is None and time.monotonic() < end:
            time.sleep(0.05)
        assert "active" in log.read_text(), tail(log)

    def sockets(self, name: str) -> list[tuple[str, int]]:
        """Addresses and ports of a node's UDP sockets, by the kernel's list (man proc, /proc/net/udp)."""
        pid = self.processes.children[name].process.pid
        links = [os.readlink(path) for path in Path(f"/proc/{pid}/fd").iterdir()]
        inodes = {match[1] for link in links if (match := re.match(r"socket:\[(\d+)\]", link))}
        rows = [row.split() for row in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]]
        local = [row[1].split(":") for row in rows if row[9] in inodes]
        assert Path(f"/proc/{pid}/net/udp6").read_text().count("\n") == 1, "IPv6 is not looked at here"
        octets = [bytes.fromhex(address)[::-1] for address, _ in local]
        return [(".".join(map(str, o)), int(port, 16)) for o, (_, port) in zip(octets, local, strict=True)]

    def close(self) -> None:
        self.processes.close()
        shared_memory.remove_orphans(self.started_ns)


def heard(prefix: list[str], robot: Robot, **variables: str) -> dict:
    """What came of a stranger's attempt, which ends as soon as the arm has stopped."""
    command = [*prefix, sys.executable, str(HERE / "stranger.py"), str(ATTEMPT)]
    done = subprocess.run(command, env={**robot.variables, **variables}, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture
def robot(hosts, tmp_path, request) -> Iterator[Robot]:
    """With what the user has set as the test's parameter."""
    variables = dict(ros_environment(tmp_path / "ros").variables)
    del variables[RANGE]
    for name in (PEERS, "FASTDDS_DEFAULT_PROFILES_FILE"):
        variables.pop(name, None)
    robot = Robot(tmp_path, hosts.robot, {**variables, **request.param})
    yield robot
    robot.close()


@pytest.mark.parametrize("robot", [{}, {RANGE: "LOCALHOST"}], indirect=True, ids=["nothing set", "LOCALHOST"])
def test_another_host_is_not_heard_whoever_it_names_and_this_host_is(robot, hosts):
    found = heard(hosts.other, robot, **{RANGE: "SUBNET", PEERS: ROBOT})
    assert "plain" in found["nodes"], "the stranger does not even see the plain node: this shows nothing"
    assert set(found["nodes"]) == {"plain"} and found["listeners"] == [0, 0]
    assert not found["goal"] and found["mode"] is None
    assert "emergency stop" not in (robot.folder / "sim.log").read_text()
    for name in ("sim", "controller"):
        listening = {address for address, port in robot.sockets(name) if port < EPHEMERAL}
        assert listening == {"127.0.0.1"}, robot.sockets(name)
    for asked in ("SUBNET", "LOCALHOST"):  # terminals without and with scripts/env.sh
        local = heard(hosts.robot, robot, **{RANGE: asked})
        assert local["goal"] and local["mode"] == ArmStatus.ESTOP and min(local["listeners"]) > 0, local


@pytest.mark.parametrize(
    "robot", [{RANGE: "SUBNET"}, {PEERS: STRANGER}], indirect=True, ids=["SUBNET", "static peers"]
)
def test_another_host_is_heard_where_the_user_asks_for_it(robot, hosts):
    found = heard(hosts.other, robot, **{RANGE: "SUBNET", PEERS: ROBOT})
    assert found["goal"] and found["mode"] == ArmStatus.ESTOP and min(found["listeners"]) > 0, found
