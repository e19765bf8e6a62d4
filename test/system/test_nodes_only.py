"""A graph that waits for goals: stopped, looked at, reset and given another goal from a second terminal."""

import signal
import subprocess
import sys

import pytest
from launched import Launched

pytestmark = pytest.mark.ros

TACTILE = [sys.executable, "-m", "tactile_bringup.cli"]
GOAL = "{direction_deg: 0, length: 0.02}"


def test_a_launch_without_goals_outlives_a_stop_and_takes_goals_until_it_is_ended(tmp_path):
    words = ["launch", "surface_following", "--scene", "plane", "--nodes-only", "--headless"]
    launch = Launched(tmp_path, [*TACTILE, *words, "--out", str(tmp_path)])
    try:
        launch.wait_for("waiting for goals of others")
        domain = launch.output.split("ROS domain ")[1].split()[0]

        def tactile(*words: str, code: int = 0) -> str:
            command = ["env", f"ROS_DOMAIN_ID={domain}", *TACTILE, *words]
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
            assert done.returncode == code, done.stdout + done.stderr
            return done.stdout + done.stderr

        assert "/arm rests" in tactile("stop")
        assert "emergency stop: asked for by `tactile stop`" in tactile("status", code=1)
        tactile("goal", GOAL, code=1)  # an arm that was stopped takes none
        assert "the arm moves again once" in tactile("reset")
        assert "done" in tactile("goal", GOAL)
        other = subprocess.Popen(
            ["env", f"ROS_DOMAIN_ID={domain}", *TACTILE, "goal", GOAL], stdout=subprocess.PIPE, text=True
        )
        for _ in range(60):
            if "task:" in tactile("status"):
                break
        launch.process.send_signal(signal.SIGINT)
        assert launch.end() == 130, launch.output
        assert "stopped: the arm rests" in launch.output
        assert other.wait(60) != 0
    finally:
        launch.kill()
