"""Tasks of two arms on the page, in a real browser: each arm is there, and what it touches moves."""

import signal
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from browser import Viewer, chromium, wait
from launched import Launched

from tactile_base.config_paths import config_path

pytest.importorskip("rclpy", reason="needs ROS 2")
pytestmark = [pytest.mark.ros, pytest.mark.slow]

SCENES = {"object_tracking": "tracking_flat", "dual_pushing": "dual_pushing"}
FEELS = {"object_tracking": ("follower",), "dual_pushing": ("follower", "leader")}
# Beside a browser that draws in software a process may be held up: it only delays the task.
PATIENT = ("watchdog.patience=30", "watchdog.start_timeout=60")
# And slower than it could, so that whoever is held up does not fall behind what it holds.
UNHURRIED = {"object_tracking": "leader.task.speed_factor=0.2", "dual_pushing": "leader.task.stuck_time=60"}
IN_CONTACT = ("contact.approach_timeout=100", "contact.settle_timeout=100")
AGE = "state_age: 10.0"


def launched(folder: Path, task: str) -> Launched:
    text = config_path(f"scenes/{SCENES[task]}.yaml").read_text()
    aged = text.replace("    safety: {", f"    safety: {{{AGE}, ")
    if aged == text:
        aged = text.replace("    driver: sim\n", f"    driver: sim\n    safety: {{{AGE}}}\n")
    assert aged.count(AGE) == 2
    scene = folder / f"{SCENES[task]}.yaml"
    scene.write_text(aged)
    words = ["launch", task, "--scene", str(scene), "--headless", "--rate", "20", "--out", str(folder)]
    words += ["--set", UNHURRIED[task]]
    for role in ("leader", "follower"):
        for setting in (*PATIENT, *(IN_CONTACT if role in FEELS[task] else ())):
            words += ["--set", f"{role}.{setting}"]
    return Launched(folder, [sys.executable, "-m", "tactile_bringup.cli", *words])


@pytest.mark.parametrize("task", SCENES)
def test_both_arms_are_there_and_the_image_of_each_that_feels_moves(tmp_path, task):
    with chromium() as browser:
        launch = launched(tmp_path, task)
        try:
            launch.wait_for("ROS domain")
            domain = launch.output.split("ROS domain ")[1].split()[0]
            with closing(Viewer(browser, tmp_path, "--port", "0", ROS_DOMAIN_ID=domain)) as viewer:
                check(viewer, FEELS[task], launch)
            launch.process.send_signal(signal.SIGINT)
            launch.end()
        finally:
            launch.kill()


def check(viewer: Viewer, feels: tuple[str, ...], launch: Launched) -> None:
    for arm in ("leader", "follower"):
        viewer.choose("arm", arm)
        assert viewer.sees(f"commanded by /{arm}/controller")
        if arm in feels:
            first = viewer.images()
            assert wait(lambda first=first: viewer.images() != first), launch.output
    assert wait(lambda: len(np.unique(viewer.picture().reshape(-1, 3), axis=0)) > 100), "it is empty"
