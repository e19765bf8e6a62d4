"""The command line: what it offers, and what it says when something is wrong."""

import os
import resource
import subprocess
import sys

import pytest

from tactile_base.config_paths import config_path
from tactile_base.version import version
from tactile_base.whole_file import only_writer, room_for_results
from tactile_bringup import cli
from tactile_perception.estimating.estimator import shipped_model

WITHOUT_MCAP_AND_RUCKIG = """
import importlib.util
find = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name in ("mcap", "ruckig") else find(name)
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


@pytest.fixture
def damaged(tmp_path):
    """A model of which one bit was turned."""
    data = bytearray(shipped_model().read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "own.onnx").write_bytes(data)
    return tmp_path / "own.onnx"


@pytest.mark.parametrize("command", ["launch surface_following", "demo", "launch dual_pushing"])
def test_a_damaged_model_is_refused_before_a_node_is_started(capsys, tmp_path, damaged, command):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    assert cli.main([*command.split(), "--out", str(tmp_path), "--model", str(damaged), "--headless"]) == 2
    shown = capsys.readouterr().out
    assert f"tactile {command.split()[0]}: model of /" in shown and f"/estimator: {damaged}: " in shown
    assert "nothing was started" in shown and not list(tmp_path.glob("**/logs"))


def test_a_damaged_model_of_a_scene_is_refused_before_a_node_is_started(capsys, tmp_path, damaged):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    text = config_path("scenes/plane.yaml").read_text()
    own = text.replace("      camera_rate: 60", f"      model: {damaged.name}\n      camera_rate: 60", 1)
    (tmp_path / "cell.yaml").write_text(own)
    scene = ["--scene", str(tmp_path / "cell.yaml")]
    assert cli.main(["launch", "surface_following", *scene, "--out", str(tmp_path), "--headless"]) == 2
    assert f"model of /arm/estimator: {damaged}: " in capsys.readouterr().out


@pytest.mark.parametrize("command", ["version", "launch surface_following"])
def test_too_little_address_space_is_a_sentence_in_place_of_a_crash(command):
    limited = f'ulimit -v 500000 && exec "{sys.executable}" -m tactile_bringup.cli {command}'
    done = subprocess.run(["sh", "-c", limited], capture_output=True, text=True)
    assert done.returncode == 2 and not done.stdout
    assert done.stderr.startswith(
        "tactile: no process may have more than 500000 KiB of address space, a command"
    )


def test_a_bag_that_exists_is_not_overwritten(tmp_path, capsys):
    assert cli.main(["launch", "surface_following", "--record", str(tmp_path)]) == 2
    assert f"--record {tmp_path}: exists already" in capsys.readouterr().err


def test_the_demo_removes_nothing_that_is_no_bag(tmp_path, capsys):
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "thesis.tex").touch()
    assert cli.main(["demo", "--out", str(tmp_path)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tmp_path / "bag" / "thesis.tex").exists()


def test_earlier_results_are_kept_beside_new_ones(tmp_path, capsys):
    folder = tmp_path / "out"
    for number in range(3):
        room_for_results(folder, "report.json", "*/report.json")
        (folder / "arm").mkdir(parents=True)
        (folder / "arm" / "report.json").write_text(str(number))
    kept = [(tmp_path / name / "arm" / "report.json").read_text() for name in ("out-1", "out-2", "out")]
    assert kept == ["0", "1", "2"]
    assert f"earlier results of {folder} are in {folder}-2 now" in capsys.readouterr().err


def test_results_stay_where_what_they_are_of_is_read_from_and_others_things_as_well(tmp_path, monkeypatch):
    (tmp_path / "report.json").touch()
    room_for_results(tmp_path, "report.json", source=tmp_path / "bag")
    room_for_results(tmp_path, "results.json")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileExistsError, match="name a folder for new ones"):
        room_for_results(tmp_path, "report.json")


def test_help_comes_without_ros_and_without_heavy_libraries():
    code = "import sys\nfrom tactile_bringup import cli\ncli.command_line(['--help'])\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert not loaded & {"rclpy", "torch", "onnxruntime", "matplotlib", "numpy", "rich"}


def test_doctor_says_so_where_no_twist_was_sent(monkeypatch):
    from tactile_bringup import timing

    nothing = {"latency_ms": {"p50": None, "p99": None, "max": None}, "end": "the pose is old"}
    monkeypatch.setattr(timing, "measured", lambda task: nothing)
    finding = timing.check_exposure_to_twist()
    assert finding.verdict == timing.FAILED and finding.found == "no run: the pose is old"


def test_doctor_names_what_is_missing(capsys, monkeypatch):
    from tactile_bringup.commands import doctor

    def absent() -> str:
        raise doctor.Missing("no such thing; build it")

    monkeypatch.setattr(doctor, "CHECKS", {"Python": doctor.CHECKS["Python"], "thing": absent})
    assert cli.main(["doctor"]) == 1
    shown = capsys.readouterr().out
    assert "MISSING  thing: no such thing; build it" in shown and "1 of 2 checks failed" in shown


def test_a_command_that_needs_ros_says_so_where_there_is_none(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    loaded = [name for name in sys.modules if name.startswith("tactile_bringup.launching")]
    for name in loaded:
        monkeypatch.delitem(sys.modules, name)
    assert cli.main(["status"]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("tactile status: needs ROS 2") and "`. scripts/env.sh`" in shown


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
    (tmp_path / "sitecustomize.py").write_text(WITHOUT_MCAP_AND_RUCKIG)
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path}
    )
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "Python packages are missing: ruckig, mcap; type: " in done.stderr
    assert f"{sys.executable} -m pip install" in done.stderr


def test_a_folder_has_one_writer_at_a_time(tmp_path):
    with only_writer(tmp_path), pytest.raises(BlockingIOError, match="another process is writing"):
        only_writer(tmp_path)
    only_writer(tmp_path).close()
