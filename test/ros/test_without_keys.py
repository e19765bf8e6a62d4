"""DDS security where there is none, as in the wheels: nodes do not start, and `tactile doctor` says so."""

import os
import subprocess
import sys

import pytest

DOCTOR = [sys.executable, "-m", "tactile_bringup.cli", "doctor"]


def run(command: list[str], **variables: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        command, env={**os.environ, **variables}, capture_output=True, text=True, timeout=60
    )


@pytest.mark.parametrize("strategy", ["Enforce", "Permissive"])
def test_a_node_whose_enclave_cannot_be_kept_does_not_start(tmp_path, strategy):
    (tmp_path / "enclaves/arm/filter").mkdir(parents=True)
    asked = {
        "ROS_SECURITY_ENABLE": "true",
        "ROS_SECURITY_STRATEGY": strategy,
        "ROS_SECURITY_KEYSTORE": str(tmp_path),
    }
    command = [
        sys.executable,
        "-m",
        "tactile_ros.nodes.filter_node",
        "--ros-args",
        "--enclave",
        "/arm/filter",
    ]
    ended = run(command, **asked)
    assert ended.returncode != 0 and "active" not in ended.stdout + ended.stderr
    assert "security" in ended.stderr


def test_doctor_tells_whether_the_middleware_has_security_and_whether_it_would_be_enforced():
    told = next(line for line in run(DOCTOR).stdout.splitlines() if "DDS security" in line)
    assert told.startswith("ok ") and ("do not start" in told or "does not start" in told), told
    asked = run(DOCTOR, ROS_SECURITY_ENABLE="true")
    assert (
        "MISSING  DDS security: ROS_SECURITY_STRATEGY is not Enforce" in asked.stdout
        and asked.returncode == 1
    )
    if "built without it" in told:
        asked = run(DOCTOR, ROS_SECURITY_ENABLE="true", ROS_SECURITY_STRATEGY="Enforce")
        assert "MISSING  DDS security: this middleware is built without it" in asked.stdout
