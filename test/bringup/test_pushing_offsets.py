"""Offsets of sensors are found again from the errors that they make."""

import json

import numpy as np
import pytest

from tactile_bringup.cli import main
from tactile_bringup.experiments import pushing_offsets
from tactile_bringup.experiments.pushing_offsets import Rows, fit_offsets

NAMES = ("contact_angle", "contact_offset")


class Slopes:
    """Rows whose errors are linear in the offsets, with one that nothing explains."""

    def __init__(self, offsets, outlier=0.0):
        random = np.random.default_rng(0)
        self.slopes, self.constant = random.uniform(-3.0, 3.0, (8, 2)), random.normal(0.0, 1.0, 8)
        self.rows = {}
        for k, (what, floor) in enumerate(pushing_offsets.table_of("single").rows()):
            self.rows[what, floor] = k
        self.means = self.constant + self.slopes @ np.array(offsets)
        self.means[0] += outlier

    def __call__(self, trials):
        return [self.row(trial) for trial in trials]

    def row(self, trial):
        k, varied = self.rows[trial.object, trial.floor], dict(trial.varied)
        assert all(varied[name] == 0.0 for name, _ in pushing_offsets.NOTHING_DRAWN)
        error = self.constant[k] + self.slopes[k] @ [varied[name] for name in NAMES]
        done = {"succeeded": True, "contact_lost": False, "toppled": False, "work_s": 40.0}
        return done | {"error_mm": error + 0.01 * (2 * trial.number - 1), "trial": trial.number}


def rows_of(slopes):
    rows = Rows(("single",), NAMES, slopes)
    rows.paper = np.column_stack([slopes.means, np.full(8, 0.1)])
    return rows


def test_offsets_are_found_from_the_errors_that_they_make():
    fit = fit_offsets(rows_of(Slopes((2.0, -0.7))))
    assert list(fit.offsets.values()) == pytest.approx([2.0, -0.7], abs=0.05)
    assert fit.within(fit.after) == 8 and fit.missed(fit.after) < 0.05 < fit.missed(fit.before)


def test_a_row_that_they_do_not_explain_pulls_little_and_widens_the_deviations():
    plain, off = (fit_offsets(rows_of(Slopes((2.0, -0.7), outlier))) for outlier in (0.0, 15.0))
    assert list(off.offsets.values()) == pytest.approx([2.0, -0.7], abs=0.5)
    assert all(off.deviations[name] > 10.0 * plain.deviations[name] for name in NAMES)
    assert " ".join(off.words()).count("within its deviation") == 2


def test_the_command_writes_its_tables(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(pushing_offsets, "MOST", 1)
    cells = {"one arm": (("single",), ("contact_angle",))}
    monkeypatch.setattr("tactile_bringup.commands.experiment.CELLS", cells)
    assert main(["experiment", "offsets", "--trials", "1", "--jobs", "1", "--out", str(tmp_path / "o")]) == 0
    assert json.loads((tmp_path / "o/offsets.json").read_text()).keys() == {"one arm"}
    assert (tmp_path / "o/one_arm.md").read_text().count("\n") == 10
    assert "sensor turned in its tool" in capsys.readouterr().out
