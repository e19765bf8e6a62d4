"""Trials: each is done once, wherever it runs, and what was done survives an interruption."""

import json
import sys

import pytest
from squares import Square, refuse, square

from tactile_base.cluster import ClusterError
from tactile_bringup.trials import TrialRows, run_trials

TRIALS = [Square(number) for number in range(5)]


def results(rows):
    return {row["name"]: row["result"] for row in rows}


WANTED = {f"square/{n}": n**2 for n in range(5)}


@pytest.mark.parametrize("processes", [1, 2])
def test_every_trial_gives_its_row_in_this_process_and_in_others(processes):
    assert results(run_trials(square, TRIALS, processes)) == WANTED


def test_workers_of_a_cluster_give_the_same_rows():
    distributed = pytest.importorskip("distributed", reason="needs Dask (the extra 'cluster')")
    with distributed.LocalCluster(
        n_workers=1, processes=False, dashboard_address=None, protocol="tcp"
    ) as local:
        assert results(run_trials(square, TRIALS, scheduler=local.scheduler_address)) == WANTED


def test_a_cluster_without_dask_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ClusterError, match=r"needs Dask: pip install distributed"):
        list(run_trials(square, TRIALS, scheduler="tcp://127.0.0.1:8786"))


@pytest.mark.parametrize("processes", [1, 2])
def test_a_trial_that_cannot_be_ends_the_run_with_its_reason(processes):
    with pytest.raises(ValueError, match=r"square/\d cannot be"):
        list(run_trials(refuse, TRIALS, processes))


def test_a_trial_that_is_done_is_not_done_again(tmp_path):
    path = tmp_path / "trials.jsonl"
    first = TrialRows(path)
    for row in run_trials(square, TRIALS[:3]):
        first.add(row)
    again = TrialRows(path)
    assert len(again) == 3 and again.missing(TRIALS) == TRIALS[3:]
    assert results(again.of(TRIALS)) == {name: WANTED[name] for name in ("square/0", "square/1", "square/2")}


def test_a_line_that_an_interruption_cut_short_is_done_again(tmp_path):
    path = tmp_path / "trials.jsonl"
    rows = TrialRows(path)
    rows.add(square(TRIALS[0]))
    whole = path.read_text()
    path.write_text(whole + '{"name": "square/1", "res')
    again = TrialRows(path)
    assert again.missing(TRIALS[:2]) == [TRIALS[1]]
    again.add(square(TRIALS[1]))
    assert [json.loads(line)["name"] for line in path.read_text().splitlines()] == ["square/0", "square/1"]


@pytest.mark.parametrize("line", ["{", "[1]", '{"result": 3}', "\xff\xfe"])
def test_a_damaged_line_is_named(tmp_path, line):
    path = tmp_path / "trials.jsonl"
    path.write_bytes(b'{"name": "square/0", "result": 0}\n' + line.encode("latin1") + b"\n")
    with pytest.raises(ValueError, match=r"trials\.jsonl:2: is no trial"):
        TrialRows(path)
