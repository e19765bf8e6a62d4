"""`tactile simulate --view`: a run without ROS on the page while it goes on, and after it."""

import re
import signal
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest
from browser import Opened, chromium, wait

pytestmark = pytest.mark.live  # against the clock: a browser that draws in software


@contextmanager
def simulated(folder):
    """The command at work, and the address that it says."""
    words = [
        "surface_following",
        "--scene",
        "ramp",
        "--fidelity",
        "ideal",
        "--out",
        str(folder / "out"),
        "--view",
    ]
    said = folder / "said.txt"
    with subprocess.Popen(
        [sys.executable, "-m", "tactile_bringup.cli", "simulate", *words],
        stdout=said.open("w"),
        stderr=subprocess.STDOUT,
    ) as process:
        assert wait(lambda: "page: http" in said.read_text() or process.poll() is not None), said.read_text()
        try:
            yield process, re.search(r"http://[\d.]+:\d+", said.read_text())[0], said
        finally:
            process.kill()


def test_a_run_without_ros_is_on_the_page_and_stays_there_until_ctrl_c(tmp_path):
    with chromium() as browser, simulated(tmp_path) as (process, address, said):
        viewer = Opened(browser, address)
        assert viewer.sees("surface_following") and viewer.sees("follow")
        assert wait(lambda: len(np.unique(viewer.picture().reshape(-1, 3), axis=0)) > 100), "it is empty"
        assert wait(lambda: "stays on" in said.read_text()), said.read_text()
        assert "arm ramp: follow" in said.read_text(), "how far the run is stands where no terminal is, too"
        assert wait(lambda: "still being written" not in viewer.text())
        viewer.page.get_by_role("tab", name="Phases").click()
        assert viewer.sees("phase: arm: done")
        assert "contact kept" in said.read_text(), "the report is there although the page is open"
        process.send_signal(signal.SIGINT)
        assert process.wait(60.0) == 0
        assert (tmp_path / "out/report.html").exists()
        viewer.close()


def test_a_page_that_dies_leaves_the_run_as_it_is(tmp_path):
    with simulated(tmp_path) as (process, _, said):
        children = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout
        (page,) = children.split()
        subprocess.run(["kill", "-9", page], check=True)
        assert process.wait(150.0) == 0
        assert "the page has ended by itself" in " ".join(said.read_text().split())
