"""`tactile simulate --view`: a run without ROS on the page while it goes on, and after it."""

import re
import signal
import subprocess
import sys
from contextlib import contextmanager

import pytest
from browser import Opened, chromium, wait

pytestmark = pytest.mark.live  # against the clock: a browser that draws in software


RAMP = ("surface_following", "--scene", "ramp", "--fidelity", "ideal")
#: Of two arms: what is run, and who feels something.
FEELS = {"object_tracking": ("follower",), "dual_pushing": ("follower", "leader")}


@contextmanager
def simulated(folder, *words):
    """The command at work, and the address that it says."""
    said = folder / "said.txt"
    command = [sys.executable, "-m", "tactile_bringup.cli", "simulate", *words, "--view"]
    with subprocess.Popen(
        [*command, "--out", str(folder / "out")], stdout=said.open("w"), stderr=subprocess.STDOUT
    ) as process:
        assert wait(lambda: "page: http" in said.read_text() or process.poll() is not None), said.read_text()
        try:
            yield process, re.search(r"http://[\d.]+:\d+", said.read_text())[0], said
        finally:
            process.kill()


def test_a_run_without_ros_is_on_the_page_and_stays_there_until_ctrl_c(tmp_path):
    with chromium() as browser, simulated(tmp_path, *RAMP) as (process, address, said):
        viewer = Opened(browser, address)
        assert viewer.sees("surface_following") and viewer.sees("follow")
        assert viewer.is_drawn()
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
    with simulated(tmp_path, *RAMP) as (process, _, said):
        children = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout
        (page,) = children.split()
        subprocess.run(["kill", "-9", page], check=True)
        assert process.wait(150.0) == 0
        assert "the page has ended by itself" in " ".join(said.read_text().split())


@pytest.mark.parametrize("task", FEELS)
def test_both_arms_are_there_and_the_image_of_each_that_feels_moves(tmp_path, task):
    with chromium() as browser, simulated(tmp_path, task) as (_, address, said):
        viewer = Opened(browser, address)
        for arm in ("leader", "follower"):
            viewer.choose("arm", arm)
            if arm in FEELS[task]:
                first = viewer.images()
                assert wait(lambda first=first: viewer.images() != first), said.read_text()
        assert viewer.is_drawn()
        viewer.close()
