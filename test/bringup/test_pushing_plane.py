"""Pushes side by side in the plane end where those of the loop without ROS do."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_bringup.cli import main
from tactile_bringup.experiments.pushing import Common, Trial, load_tables, trial_row
from tactile_bringup.experiments.pushing_plane import Batch, plane_rows

LENGTHS = ("error_mm", "error_believed_mm", "error_axis_mm", "shear_max_mm", "tip_depth_max_mm")
WAYS = ("body_way_mm", "distance_mm")  # that end with the last exposure: one more or less is 0.17 mm


class Still(np.random.Generator):
    """Draws all but noise."""

    def standard_normal(self, size=None):
        return np.zeros(() if size is None else size)


@pytest.fixture
def without_noise(monkeypatch):
    """Estimates that are true, under the covariance that they state."""
    monkeypatch.setattr(np.random, "default_rng", lambda seed=None: Still(np.random.PCG64(seed)))


def pushes(table, controller, *rows, varied=()):
    common = Common(table, controller, "plane")
    trials = tuple(Trial(common, *row, number, varied) for row, number in rows)
    one_by_one = [trial_row(replace(trial, common=replace(common, fidelity="ideal"))) for trial in trials]
    return plane_rows(Batch(trials)), one_by_one


@pytest.mark.parametrize(
    ("table", "controller", "rows", "varied"),
    [
        ("single", "paper", [(("blue_square", "foam"), 1), (("yellow_hexagon", "mdf"), 7)], ()),
        ("single", "tuned", [(("blue_circle", "mdf"), 2)], ()),
        ("single", "paper", [(("red_square", "mdf"), 2)], (("contact_angle", 3.0), ("contact_offset", -2.0))),
        ("dual", "offset", [(("blue_circle", "foam"), 1)], ()),
        ("dual", "paper", [(("blue_square", "mdf"), 1)], (("follower_angle", 4.0), ("follower_offset", 2.0))),
        ("tall", "paper", [(("tall_red_square", "mdf"), 3)], ()),
    ],
)
def test_they_end_at_the_same_place(without_noise, table, controller, rows, varied):
    for plane, loop in zip(*pushes(table, controller, *rows, varied=varied), strict=True):
        assert plane["succeeded"] and loop["succeeded"]
        for name in LENGTHS:
            assert plane[name] == pytest.approx(loop[name], abs=0.1), name
        for name in WAYS:
            assert plane[name] == pytest.approx(loop[name], abs=0.3), name
        assert plane["body_turned_deg"] == pytest.approx(loop["body_turned_deg"], abs=0.2)
        assert plane["work_s"] == pytest.approx(loop["work_s"], abs=0.1)
        assert {name for name in loop if name not in plane} == set()


def test_a_trial_has_the_same_row_in_any_company():
    common = Common("single", "tuned", "plane")
    trials = [Trial(common, *row, number) for row in load_tables()["single"].rows() for number in (0, 1)]
    alone, among = plane_rows(Batch((trials[3],)))[0], plane_rows(Batch(tuple(trials)))[3]
    assert alone["error_mm"] == pytest.approx(among["error_mm"], abs=1e-6)
    assert alone["name"] == among["name"]


def test_torch_gives_the_same_rows():
    pytest.importorskip("torch", reason="the extra 'train' is not installed")
    trials = (Trial(Common("single", "tuned", "plane"), "red_square", "foam", 0),)
    numpy, torch = (plane_rows(Batch(trials, device))[0] for device in ("numpy", "torch"))
    assert torch["error_mm"] == pytest.approx(numpy["error_mm"], abs=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("pusher.servoing.tangent_space=global",), "servoing.tangent_space has to be local"),
        (("pusher.contact.dry_touch=true",), "contact.dry_touch has to be false"),
    ],
)
def test_what_the_plane_does_not_have_is_told(changes, message):
    common = Common("single", "paper", "plane", changes=changes)
    with pytest.raises(SettingError, match=message):
        plane_rows(Batch((Trial(common, "red_square", "foam", 0),)))


def command(folder, *words):
    return main(["experiment", "pushing", "--out", str(folder), "--jobs", "1", *map(str, words)])


def test_the_command_pushes_in_the_plane(tmp_path, capsys):
    words = ["--table", "single", "--objects", "red_square", "--fidelity", "plane", "--trials", "3"]
    assert command(tmp_path, *words) == 0
    rows = [json.loads(line) for line in (tmp_path / "trials.jsonl").read_text().splitlines()]
    assert len(rows) == 6 and all(row["succeeded"] for row in rows)
    assert "| red square | mdf | 3 | 3 |" in (tmp_path / "table.md").read_text()
    assert command(tmp_path, *words, "--trial", 1) == 2
    assert "the plane keeps no record" in " ".join(capsys.readouterr().err.split())
    assert command(tmp_path / "other", *words, "--device", "abacus") == 2
    assert "device abacus: library unknown name" in " ".join(capsys.readouterr().err.split())
