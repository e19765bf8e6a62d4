"""What is drilled with real nodes: the harm is done, the arm rests, and the report says why."""

import json

import pytest

from tactile_bringup import cli

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def test_of_a_filter_that_is_killed_screen_and_report_say_so_and_the_arm_rests(tmp_path, capfd):
    out = tmp_path / "drill"
    words = ["drill", "--scene", "ramp", "--live", "--fault", "filter is killed", "--after", "1"]
    assert cli.main([*words, "--out", str(out)]) == 0, capfd.readouterr()
    (row,) = json.loads((out / "drill.json").read_text())
    assert row["fault"] == "arm: filter is killed" and row["code"] != 0
    assert "/arm/filter was killed by SIGKILL" in row["reason"]
    assert any("/arm/filter was killed by SIGKILL" in line for line in row["screen"])
    assert row["rest"] < 1.0 and 0.002 < row["deepest"] < 0.004


def test_the_timing_of_this_machine_is_told(capfd):
    code = cli.main(["doctor", "--timing"])
    said = " ".join(capfd.readouterr().out.split())
    for what in ("kernel", "cores", "real-time priority", "waking up", "exposure to twist"):
        assert f" {what}: " in said, said
    assert code == 0 or "FAILED exposure to twist" in said  # a machine that is too slow for it says so
