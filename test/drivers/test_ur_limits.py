"""Property: whatever is commanded and however states come, what the driver of a UR puts out keeps the limits.

The link to ur_rtde is replaced: it is where the driver's output is read, and where states come from, of an
arm that follows at once. Time is made up.
"""

import json
import queue
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_drivers import ur, ur_link, ur_settings
from tactile_drivers.rotation_vectors import pose_of, vector_of
from tactile_drivers.safety import SafeArm
from tactile_geometry import se3
from tactile_scene.arm import open_arm
from tactile_scene.scene_file import load_scene

SCENE = """
arms:
  arm:
    driver: ur
    driver_settings: {rate: 125.0}
    limits: {linear_velocity: 0.1, linear_acceleration: 1.0, linear_jerk: 50.0}
    start: {position: [0.4, 0.0, 0.3], rotation_deg: [180, 0, 0]}
"""
PERIOD = 0.008  # s
TIMEOUT = 0.1  # s, command_timeout of the scene


class Link:
    """In place of the process that holds ur_rtde; the arm is at the speed that was sent last."""

    waiting = False

    def __init__(self, wanted):
        facts = {"version": "5.15.0.0", "model": "UR5", "tcp_offset": [0.0] * 6, "payload": 0.0}
        self.packets, self.sent = queue.Queue(), []
        self.packets.put(ur_link.ANSWER + json.dumps(facts).encode())
        self.speed, self.T = np.zeros(6), pose_of([0.4, 0.0, 0.3, np.pi, 0.0, 0.0])

    def send(self, packet):
        if packet[:1] == b"v":
            self.speed = np.array(ur_link.SPEED.unpack(packet)[2:8])
        elif packet[:1] == b"s":
            self.speed = np.zeros(6)

    def receive(self, timeout):
        return self.packets.get()

    def end(self, patience=0.0):
        pass


class Bench:
    """Stage and driver over the replaced link, on a clock of their own."""

    def __init__(self, monkeypatch, path):
        self.now = 1000.0
        clock = SimpleNamespace(time_ns=self.now_ns, monotonic=lambda: self.now, sleep=lambda seconds: None)
        monkeypatch.setattr(ur, "time", clock)
        monkeypatch.setattr(ur, "_LinkProcess", Link)
        monkeypatch.setattr(ur_settings.importlib.util, "find_spec", lambda name: True)
        path.write_text(SCENE)
        self.scene = load_scene(path).arms["arm"]
        self.safe = SafeArm(self.scene, self.now_ns, feels=False)
        self.told = queue.Queue()
        self.driver = open_arm(self.scene, lambda state: self.told.put(self.safe.take_state(state)))
        self.safe.attach_driver(self.driver)
        self.link, self.speeds = self.driver._link, []
        self.step(1)

    def now_ns(self):
        return round(self.now * 1e9)

    def step(self, periods: int):
        """The arm goes on for some periods, then tells its state."""
        dt = periods * PERIOD
        self.now += dt
        link = self.link
        turn = se3.exp(np.concatenate([np.zeros(3), link.speed[3:] * dt]))
        link.T[:3, :3] = turn[:3, :3] @ link.T[:3, :3]
        link.T[:3, 3] += link.speed[:3] * dt
        fields = *vector_of(link.T), *link.speed, *np.zeros(6), 7, 1, 3, 2, 1.0, 0.0
        link.packets.put(ur_link.STATE.pack(b"x", self.now_ns(), self.now, *fields))
        assert self.told.get(timeout=10) is not None, self.safe.bad_state
        self.speeds.append((dt, link.speed.copy()))

    def close(self):
        self.driver._open = False
        self.link.packets.put(b"")
        self.safe.close()


commands = st.one_of(
    st.none(),  # missing
    st.tuples(*[st.floats(-0.5, 0.5)] * 3, *[st.floats(-3.0, 3.0)] * 3).map(np.array),
    st.sampled_from([np.zeros(6), np.array([0.1, 0, 0, 0, 0, 0]), np.array([-0.1, 0, 0, 0, 0, 0])]),
)
steps = st.lists(st.tuples(commands, st.integers(1, 20), st.integers(1, 3)), min_size=2, max_size=12)


def run(bench, sequence):
    """Command what is asked for, then zero until the arm rests."""
    silent = np.inf
    for twist, count, periods in sequence:
        for _ in range(count):
            if twist is not None:
                if silent > bench.scene.safety.owner_timeout:  # whoever was silent asks for rest first
                    assert not bench.safe.command(bench.now_ns(), np.zeros(6), "test")
                assert not bench.safe.command(bench.now_ns(), twist, "test")
                silent = 0.0
            elif silent <= TIMEOUT < silent + periods * PERIOD:  # as the arm's node does
                bench.safe.stop("no command")
            silent += periods * PERIOD
            bench.step(periods)
    for _ in range(60):
        assert not bench.safe.command(bench.now_ns(), np.zeros(6), "test")
        bench.step(1)


@settings(max_examples=30)
@given(sequence=steps)
def test_steps_jitter_and_missing_commands_exceed_no_limit_at_the_drivers_output(sequence, tmp_path_factory):
    with pytest.MonkeyPatch.context() as monkeypatch:
        bench = Bench(monkeypatch, tmp_path_factory.mktemp("ur") / "cell.yaml")
        try:
            run(bench, sequence)
        finally:
            bench.close()
    dt, speeds = (np.array(column) for column in zip(*bench.speeds, strict=True))
    limits, turning = bench.scene.limits, bench.scene.limits.angular_velocity
    # each axis of the turning frame has the limits; in the base their norm, and what the turning adds
    velocity = np.linalg.norm(speeds[:, :3], axis=1).max()
    acceleration = np.diff(speeds[:, :3], axis=0) / dt[1:, None]
    jerk = np.diff(acceleration, axis=0) / (0.5 * (dt[1:-1] + dt[2:]))[:, None]
    most = np.sqrt(3.0)
    whirl = most * turning
    assert velocity <= most * limits.linear_velocity * (1 + 1e-6)
    largest = most * limits.linear_acceleration + whirl * velocity
    assert np.linalg.norm(acceleration, axis=1).max() <= largest * (1 + 1e-6)
    angular = np.linalg.norm(np.diff(speeds[:, 3:], axis=0), axis=1) / dt[1:]
    assert angular.max() <= (most * limits.angular_acceleration + whirl * whirl) * (1 + 1e-6)
    if not speeds[:, 3:].any():
        assert np.abs(speeds[:, :3]).max() <= limits.linear_velocity * (1 + 1e-6)
        assert np.abs(acceleration).max() <= limits.linear_acceleration * (1 + 1e-6)
        assert np.abs(jerk).max() <= limits.linear_jerk * (1 + 1e-6)
    assert not speeds[-1].any()
