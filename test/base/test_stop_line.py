"""Stop lines: sockets of this host by which arms are stopped without ROS."""

import os
import socket
import subprocess
import sys
import threading

import pytest

from tactile_base.stop_line import ASK, STOP, StopCaller, StopLine, arms_here, folder


@pytest.fixture(autouse=True)
def own_folder(tmp_path, monkeypatch):
    """Lines of this test alone; the path of a socket is short."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTILE_STOP_FOLDER", "lines")


class Arm:
    """What a line is told, and what it is answered with."""

    def __init__(self, name: str, domain: int = 7) -> None:
        self.reasons: list[str] = []
        self.rests = threading.Event()
        self.line = StopLine(name, domain, self.reasons.append, lambda: (self.rests.is_set(), "estop"))


@pytest.fixture
def make():
    arms = []

    def make(*arguments) -> Arm:
        arms.append(Arm(*arguments))
        return arms[-1]

    yield make
    for arm in arms:
        arm.line.close()
    assert os.listdir(folder()) == []


def test_a_stop_reaches_every_arm_and_is_answered_again_when_the_arm_rests(make):
    arms = {"/left": make("/left"), "/right": make("/right")}
    with StopCaller() as caller:
        assert caller.call(STOP) == 2
        words = caller.words(10.0)
        assert {next(words).arm, next(words).arm} == set(arms)
        for name, arm in arms.items():
            assert arm.reasons == ["asked for by `tactile stop`"]
            arm.rests.set()
            word = next(words)
            assert (word.arm, word.domain, word.pid, word.rests) == (name, 7, os.getpid(), True)


def test_a_stop_of_one_leaves_others_alone_which_answer_all_the_same(make):
    arms = {"/left": make("/left"), "/left_2": make("/left_2")}
    with StopCaller() as caller:
        assert caller.call(STOP, ["/left", "/nobody"]) == 2
        words = caller.words(10.0)
        assert {next(words).arm, next(words).arm} == set(arms)
    assert arms["/left"].reasons and not arms["/left_2"].reasons


def test_asking_stops_nothing(make):
    arm = make("/arm")
    with StopCaller() as caller:
        assert caller.call(ASK) == 1
        word = next(caller.words(10.0))
    assert not word.rests and word.text == "estop" and arm.reasons == []


def test_arms_of_another_domain_are_left_alone(make):
    mine, other = make("/arm", 7), make("/arm", 70)
    with StopCaller(7) as caller:
        assert caller.call(STOP) == 1
        assert next(caller.words(10.0)).domain == 7
    assert mine.reasons and not other.reasons
    assert [word.domain for word in arms_here(timeout_s=10.0)] == [7, 70]


def test_a_line_whose_process_was_killed_is_passed_over_and_removed(make):
    make("/arm")
    code = (
        "from tactile_base.stop_line import StopLine; import os, signal;"
        "StopLine('/dead', 7, print, lambda: (True, '')); os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", code])
    assert len(os.listdir(folder())) == 2
    assert [word.arm for word in arms_here(timeout_s=10.0)] == ["/arm"]
    assert len(os.listdir(folder())) == 1


def test_a_node_that_stands_still_counts_as_one_that_does_not_answer(make):
    make("/arm")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as still:
        still.bind("lines/7-1-0")
        with StopCaller() as caller:
            for _ in range(2000):  # more than its socket holds
                assert caller.call(ASK) == 2
                next(caller.words(10.0))
    os.unlink("lines/7-1-0")


@pytest.mark.parametrize("sent", [b"", b"stop all", b"\xff" * 3000])
def test_what_is_no_call_is_passed_over(make, sent):
    arm = make("/arm")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(sent, f"lines/{os.listdir(folder())[0]}")
    with StopCaller() as caller:
        caller.call(STOP)
        next(caller.words(10.0))
    assert len(arm.reasons) == 1


def test_a_folder_that_others_may_write_to_is_not_believed(tmp_path):
    (tmp_path / "lines").mkdir()
    (tmp_path / "lines").chmod(0o777)
    with pytest.raises(PermissionError, match="must be a folder that belongs to you"):
        StopCaller()
