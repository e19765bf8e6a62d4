"""Processes are asked to end by signals, and by their launcher's end."""

import os
import signal
import subprocess
import sys
import time

import pytest

from tactile_base import end_signals
from tactile_base.end_signals import LAUNCHER, SAME_REQUEST, signals_into

CHILD = """
import time
from tactile_base.end_signals import end_with_launcher
end_with_launcher()
print("up", flush=True)
time.sleep(60)
"""
PARENT = f"""
import os, subprocess, sys
os.environ["{LAUNCHER}"] = str(os.getpid())
child = subprocess.Popen([sys.executable, "-c", {CHILD!r}], stdout=subprocess.PIPE, text=True)
print(child.stdout.readline().strip(), child.pid, flush=True)
child.wait()
"""


@pytest.fixture
def received():
    numbers: list[int] = []
    before = signals_into(numbers)
    yield numbers
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_that_come_together_are_one_request_and_later_ones_another(received, monkeypatch, number):
    now = [100.0]
    monkeypatch.setattr(end_signals.time, "monotonic", lambda: now[0])
    for at, sent in ((100.0, number), (100.5, signal.SIGINT), (100.0 + SAME_REQUEST, signal.SIGTERM)):
        now[0] = at
        os.kill(os.getpid(), sent)
    assert received == [number, signal.SIGTERM]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_process_ends_with_its_launcher_however_that_ends(number):
    parent = subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    up, child = parent.stdout.readline().split()
    assert up == "up"
    parent.send_signal(number)
    parent.wait()
    deadline = time.monotonic() + 30.0
    while lives(int(child)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not lives(int(child))


def test_a_process_whose_launcher_has_ended_does_not_start():
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    environment = {**os.environ, LAUNCHER: str(gone.pid)}
    done = subprocess.run([sys.executable, "-c", CHILD], env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (1, "")


def lives(process: int) -> bool:
    """Whether a process exists and is no zombie, which waits for whoever has inherited it."""
    try:
        with open(f"/proc/{process}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False
