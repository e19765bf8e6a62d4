"""`tactile check`: what keeps its contract passes, and each mistake is named in words of the contract."""

import os
import subprocess
import sys
from types import SimpleNamespace

import mistakes
import pytest
from other_package import installed

from tactile_base.settings import SettingError
from tactile_bringup import cli, driver_check
from tactile_bringup.plugin_check import REGISTRIES, check_plugin


@pytest.fixture(autouse=True)
def bench(tmp_path, monkeypatch):
    """The other package, installed, and a scene with its drivers."""
    (tmp_path / "site").mkdir()
    for folder in installed(tmp_path / "site"):
        monkeypatch.syspath_prepend(folder)
    monkeypatch.setattr(driver_check, "LISTEN", 0.4)
    path = tmp_path / "cell.yaml"
    path.write_text(
        "arms:\n  arm: {driver: bench_arm, start: {position: [0, 0, 0.3], rotation_deg: [0, 180, 0]}, "
        "sensor: {camera: bench_camera, camera_rate: 60}}\n"
    )
    yield SimpleNamespace(scene=str(path), module=__import__("bench_cell"))
    sys.modules.pop("bench_cell", None)


@pytest.fixture
def problems(monkeypatch, bench):
    """What is found of a class that is not installed."""

    def find(kind, plugin, **options) -> str:
        monkeypatch.setitem(sys.modules, "mine", SimpleNamespace(Mine=plugin))
        drives = kind.endswith("driver")
        return "; ".join(check_plugin(kind, "mine:Mine", scene=bench.scene if drives else "", **options))

    return find


def test_all_that_this_package_brings_keeps_its_contract():
    for registry in REGISTRIES:
        for entry in registry.entries():
            if entry.package == "tactile_servoing":
                assert registry.contract.objections(registry.load(entry.name)) == [], entry
    for shape in ("plane", "ramp", "dome", "box", "cylinder", "sphere", "prism"):
        assert check_plugin("shape", shape) == []
    for task in ("surface_following", "object_tracking"):
        assert check_plugin("task", task) == []


# ---- shapes ----


@pytest.mark.parametrize("words", mistakes.SHAPES)
def test_a_mistake_in_a_shape_is_named(problems, words):
    assert words in problems("shape", mistakes.SHAPES[words])


# ---- motions ----


@pytest.mark.parametrize("words", mistakes.MOTIONS)
def test_a_mistake_in_a_motion_is_named(problems, bench, words):
    assert words in problems("body motion", mistakes.made(mistakes.MOTIONS[words]))


def test_a_motion_that_keeps_its_contract_passes(problems, bench):
    assert problems("body motion", bench.module.Drift) == ""


# ---- tasks ----


@pytest.mark.parametrize("words", mistakes.TASKS)
def test_a_mistake_in_a_task_is_named(problems, words):
    assert words in problems("task", mistakes.TASKS[words])


def test_a_task_that_computes_for_too_long_is_named_and_one_that_is_kept_from_its_core_is_not(problems):
    core = min(os.sched_getaffinity(0))
    assert "ms and more" in problems("task", mistakes.working(0.012)[0])
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    before = os.sched_getaffinity(0)
    try:
        for process in (0, busy.pid):
            os.sched_setaffinity(process, {core})
        task, took = mistakes.working(0.006)
        assert problems("task", task) == ""
    finally:
        os.sched_setaffinity(0, before)
        busy.kill()
        busy.wait()
    assert sum(seconds > 0.01 for seconds in took) >= 3


# ---- arms ----


@pytest.mark.parametrize("words", mistakes.ARMS)
def test_a_mistake_in_an_arm_is_named(problems, bench, words):
    found = problems("arm driver", mistakes.made(mistakes.ARMS[words]))
    assert words in found


def test_an_arm_that_reports_after_its_end_is_named(problems, bench):
    kept = []

    def __init__(self, *given):
        kept.append(self)
        bench.module.BenchArm.__init__(self, *given)

    plugin = mistakes.like(bench.module.BenchArm, __init__=__init__, close=lambda self: None)
    try:
        assert "a state is reported after close" in problems("arm driver", plugin)
    finally:
        bench.module.BenchArm.close(kept[0])


@pytest.mark.live
def test_an_arm_that_does_not_stop_is_named(problems, bench):
    assert problems("arm driver", bench.module.BenchArm, moves=True) == ""
    found = problems("arm driver", mistakes.goes_on(), moves=True)
    assert "after it was stopped" in found


# ---- cameras ----


@pytest.mark.live
@pytest.mark.parametrize("words", mistakes.CAMERAS)
def test_a_mistake_in_a_camera_is_named(problems, bench, words):
    assert words in problems("camera driver", mistakes.made(mistakes.CAMERAS[words]))


# ---- the command, and what is loaded ----


def test_the_command_says_what_was_found(bench, capsys):
    assert cli.main(["check", "drift"]) == 0
    assert "body motion drift: keeps its contract" in capsys.readouterr().out
    assert cli.main(["check", "dome", "--set", "radius=-1"]) == 2
    assert "radius" in capsys.readouterr().err
    assert cli.main(["check", "bench_arm"]) == 2
    assert "--scene my_cell.yaml" in capsys.readouterr().err
    assert cli.main(["check", "nothing"]) == 2
    assert "no plug-in has that name" in capsys.readouterr().err


def test_a_wrong_signature_is_refused_when_it_is_loaded_before_anything_moves(bench, monkeypatch):
    from tactile_scene.arm import ARMS as REGISTRY

    monkeypatch.setattr(bench.module.BenchArm, "command", lambda self, twist: None)
    with pytest.raises(
        SettingError, match=r"command\(twist\) is called as command\(stamp_ns, twist\).*py:\d+"
    ):
        REGISTRY.load("bench_arm")
