"""What is drilled with real nodes: the harm is done, the arm rests, and the report says why."""

import json

import pytest

from tactile_bringup import cli

pytestmark = [pytest.mark.ros, pytest.mark.slow]


def test_screen_and_report_say_what_was_done_to_a_node_and_the_arm_rests(tmp_path, capfd):
    out = tmp_path / "drill"
    faults = ["filter is killed", "arm is deactivated"]
    words = ["drill", "--scene", "ramp", "--live", "--fault", *faults, "--after", "1"]
    assert cli.main([*words, "--out", str(out)]) == 0, capfd.readouterr()
    rows = json.loads((out / "drill.json").read_text())
    said = "/arm/filter was killed by SIGKILL", "the arm's node has said nothing for"
    for row, fault, reason in zip(rows, faults, said, strict=True):
        assert row["fault"] == f"arm: {fault}" and row["code"] != 0
        assert reason in row["reason"] and any(reason in line for line in row["screen"])
        assert row["rest"] < 1.0 and 0.002 < row["deepest"] < 0.004


def test_the_timing_of_this_machine_is_told(capfd):
    code = cli.main(["doctor", "--timing"])
    said = " ".join(capfd.readouterr().out.split())
    for what in ("kernel", "cores", "real-time priority", "waking up", "exposure to twist"):
        assert f" {what}: " in said, said
    assert code == 0 or "FAILED exposure to twist" in said  # a machine that is too slow for it says so
