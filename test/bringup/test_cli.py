"""The command line: what it offers, and what it says when something is wrong."""

import os
import resource
import subprocess
import sys

import pytest

from tactile_base.version import version
from tactile_bringup import cli

WITHOUT_MCAP_AND_LZ4 = """
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name in ("mcap", "lz4") else find(name)
"""


def test_help_names_every_command(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    shown = capsys.readouterr().out
    for command in ("launch", "run", "demo", "simulate", "estimate", "train", "data", "doctor", "version"):
        assert f"\n    {command} " in shown


def test_every_command_has_help(capsys):
    for command in ("launch", "run", "demo", "simulate", "estimate", "train", "data", "doctor"):
        with pytest.raises(SystemExit) as ended:
            cli.main([command, "--help"])
        assert ended.value.code == 0 and "usage: tactile" in capsys.readouterr().out


def test_the_version_is_that_of_the_package(capsys):
    assert cli.main(["version"]) == 0
    assert capsys.readouterr().out.strip() == version()
    assert version()[0].isdigit()


def test_an_unknown_command_ends_with_2_and_lists_the_commands(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["lunch"])
    assert ended.value.code == 2
    assert "'launch'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--scene", "ram"], "did you mean 'ramp'"),
        (["--scene", "/no/such/scene.yaml"], "/no/such/scene.yaml: no such scene file"),
        (["--model", "/no/such.onnx"], "--model /no/such.onnx: no such file"),
        (["--rate", "0.5"], "--rate 0.5: must lie in [1, 240] Hz"),
        (["--object-belief", "two_arm"], "did you mean 'two_arms'"),
        (["--record-images"], "--record-images needs --record BAG"),
    ],
)
def test_a_wrong_option_of_launch_ends_with_2_and_a_message(capsys, options, message):
    assert cli.main(["launch", "surface_following", *options]) == 2
    assert message in capsys.readouterr().err


def test_a_bag_that_exists_is_not_overwritten(tmp_path, capsys):
    assert cli.main(["launch", "surface_following", "--record", str(tmp_path)]) == 2
    assert f"--record {tmp_path}: exists already" in capsys.readouterr().err


def test_the_demo_removes_nothing_that_is_no_bag(tmp_path, capsys):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "thesis.tex").touch()
    assert cli.main(["demo", "--out", str(tmp_path)]) == 2
    assert "exists and is no bag" in capsys.readouterr().err
    assert (tmp_path / "bag" / "thesis.tex").exists()


def test_help_comes_without_ros_and_without_heavy_libraries():
    code = "import sys\nfrom tactile_bringup import cli\ncli._parser()\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"rclpy", "torch", "onnxruntime", "matplotlib"}


def test_doctor_names_what_is_missing(capsys, monkeypatch):
    from tactile_bringup.commands import doctor

    def absent() -> str:
        raise doctor.Missing("no such thing; build it")

    monkeypatch.setattr(doctor, "CHECKS", {"Python": doctor.CHECKS["Python"], "thing": absent})
    assert cli.main(["doctor"]) == 1
    shown = capsys.readouterr().out
    assert "MISSING  thing: no such thing; build it" in shown and "1 of 2 checks failed" in shown


SHORT = "simulate --scene plane --fidelity ideal --set follower.task.timeout=0.1"


@pytest.mark.parametrize("words", [SHORT, "launch surface_following", "demo"])
def test_a_place_that_cannot_be_written_to_ends_a_command_with_a_sentence(capsys, words):
    assert cli.main([*words.split(), "--out", "/sys/out"]) in (1, 2)
    shown = capsys.readouterr().err
    assert shown.startswith(f"tactile {words.split()[0]}: ") and "/sys" in shown


def test_a_disk_that_is_full_at_the_end_of_a_simulation_is_told(tmp_path, capsys):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, limits[1]))
    try:
        status = cli.main([*SHORT.split(), "--out", str(tmp_path)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert status == 2
    assert "File too large" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command",
    [["-m", "tactile_bringup.cli", "doctor"], ["-m", "tactile_ros.nodes.recorder_node"]],
    ids=["command", "node"],
)
def test_python_packages_that_are_missing_are_named_with_what_installs_them(tmp_path, command):
    (tmp_path / "sitecustomize.py").write_text(WITHOUT_MCAP_AND_LZ4)
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "Python packages are missing: mcap, lz4; type: " in done.stderr
    assert f"{sys.executable} -m pip install" in done.stderr
