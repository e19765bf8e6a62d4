"""Jobs: each is done once, wherever it runs, and what was done survives an interruption."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from clusters import local_cluster
from squares import Killing, Slowly, Square, refuse, refuse_oddly, square

from tactile_base.jobs import ATTEMPTS, ClusterError, JobLost, JobRows, Workers, run_jobs

JOBS = [Square(number) for number in range(5)]
WANTED = {f"square/{n}": n**2 for n in range(5)}


def results(outcomes):
    rows = [outcome.result() for outcome in outcomes]
    return {row["name"]: row["result"] for row in rows}


@pytest.fixture
def cluster(request):
    """A scheduler with workers that are processes, or threads of this one."""
    with local_cluster(request.param, workers=2, threads=1) as address:
        yield address


@pytest.mark.parametrize("processes", [1, 2, 7])
@pytest.mark.parametrize("apart", [False, True])
def test_every_job_gives_its_row_in_this_process_and_in_others(processes, apart):
    assert results(run_jobs(square, JOBS, Workers(processes), apart=apart)) == WANTED


@pytest.mark.parametrize("cluster", [False], indirect=True)
@pytest.mark.parametrize("apart", [False, True])
def test_workers_of_a_cluster_give_the_same_rows(cluster, apart):
    assert results(run_jobs(square, JOBS, Workers(scheduler=cluster), apart=apart)) == WANTED


def test_a_cluster_without_dask_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ClusterError, match=r"needs Dask: pip install distributed"):
        list(run_jobs(square, JOBS, Workers(scheduler="tcp://127.0.0.1:8786")))


@pytest.mark.parametrize("workers", [Workers(1), Workers(2)])
def test_a_job_that_cannot_be_gives_its_reason_and_the_others_go_on(workers):
    outcomes = list(run_jobs(refuse, JOBS, workers))
    assert sorted(str(outcome.error) for outcome in outcomes) == [f"square/{n} cannot be" for n in range(5)]
    with pytest.raises(ValueError, match=r"square/\d cannot be"):
        outcomes[0].result()


def test_the_error_of_another_process_has_its_place_there_as_its_cause():
    (outcome,) = run_jobs(refuse, JOBS[:1], apart=True)
    assert "in refuse" in str(outcome.error.__cause__)


def test_an_error_that_cannot_be_sent_is_told_in_words():
    (outcome,) = run_jobs(refuse_oddly, JOBS[:1], apart=True)
    assert str(outcome.error) == "OddError: odd 0"


def test_work_that_cannot_be_sent_is_refused():
    with pytest.raises(Exception, match="local"):
        list(run_jobs(lambda job: square(job), JOBS, Workers(2)))


# ---- what is killed ----


@pytest.mark.parametrize("processes", [1, 2])
def test_a_job_whose_process_is_killed_is_run_again_and_no_other_is(tmp_path, processes):
    said = []
    done = run_jobs(Killing(tmp_path, times=2), JOBS, Workers(processes), said.append, apart=True)
    assert results(done) == WANTED
    assert said == ["square/3: its process was killed by SIGKILL; it is run again"] * 2
    attempts = {n: len(list(tmp_path.glob(f"{n}-*"))) for n in range(5)}
    assert attempts == {0: 1, 1: 1, 2: 1, 3: 3, 4: 1}


def test_a_job_that_kills_its_process_each_time_is_given_up_and_the_others_are_done(tmp_path):
    outcomes = list(run_jobs(Killing(tmp_path, times=100), JOBS, Workers(2)))
    (lost,) = [outcome for outcome in outcomes if outcome.error is not None]
    assert isinstance(lost.error, JobLost) and "square/3: its process was killed by SIGKILL" in str(
        lost.error
    )
    assert len(list(tmp_path.glob("3-*"))) == ATTEMPTS and len(outcomes) == 5


@pytest.mark.parametrize("cluster", [True], indirect=True)
def test_a_job_whose_worker_of_a_cluster_is_killed_is_run_again(cluster, tmp_path):
    assert results(run_jobs(Killing(tmp_path, times=1), JOBS, Workers(scheduler=cluster))) == WANTED
    assert len(list(tmp_path.glob("3-*"))) == 2


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_after_all_of_it_is_killed_it_goes_on_with_what_is_missing_and_leaves_no_process(tmp_path, number):
    script = f"""
import signal
from pathlib import Path
from squares import Slowly, Square
from tactile_base.jobs import JobRows, Workers, run_jobs
signal.signal(signal.SIGINT, signal.default_int_handler)  # also where a shell in the background ignores it
folder = Path({str(tmp_path)!r})
rows = JobRows(folder / "rows.jsonl")
for done in run_jobs(Slowly(folder), rows.missing([Square(n) for n in range(40)]), Workers(2)):
    rows.add(done.result())
"""
    path = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    process = subprocess.Popen([sys.executable, "-c", script], env={**os.environ, "PYTHONPATH": path})
    deadline = time.monotonic() + 60
    rows = tmp_path / "rows.jsonl"
    while not (rows.exists() and rows.read_text().count("\n") >= 2):
        assert time.monotonic() < deadline and process.poll() is None
        time.sleep(0.02)
    process.send_signal(number)
    assert process.wait() != 0
    theirs = [int(path.name[4:]) for path in tmp_path.glob("pid-*")]
    while any(map(alive, theirs)):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    again = JobRows(rows)
    jobs = [Square(n) for n in range(40)]
    assert 2 <= len(again) < 40 and len(again.missing(jobs)) == 40 - len(again)
    for done in run_jobs(square, again.missing(jobs)):
        again.add(done.result())
    assert [row["result"] for row in JobRows(rows).of(jobs)] == [n**2 for n in range(40)]


def test_leaving_the_iterator_ends_what_is_under_way(tmp_path):
    outcomes = run_jobs(Slowly(tmp_path), JOBS, Workers(2))
    next(outcomes)
    outcomes.close()
    assert not any(alive(int(path.name[4:])) for path in tmp_path.glob("pid-*"))


# ---- what is done ----


def test_a_job_that_is_done_is_not_done_again(tmp_path):
    path = tmp_path / "trials.jsonl"
    first = JobRows(path)
    for outcome in run_jobs(square, JOBS[:3]):
        first.add(outcome.result())
    again = JobRows(path)
    assert len(again) == 3 and again.missing(JOBS) == JOBS[3:]
    assert [row["result"] for row in again.of(JOBS)] == [0, 1, 4]


def test_a_line_that_an_interruption_cut_short_is_done_again(tmp_path):
    path = tmp_path / "trials.jsonl"
    rows = JobRows(path)
    rows.add(square(JOBS[0]))
    whole = path.read_text()
    path.write_text(whole + '{"name": "square/1", "res')
    again = JobRows(path)
    assert again.missing(JOBS[:2]) == [JOBS[1]]
    again.add(square(JOBS[1]))
    assert [json.loads(line)["name"] for line in path.read_text().splitlines()] == ["square/0", "square/1"]


@pytest.mark.parametrize("line", ["{", "[1]", '{"result": 3}', "\xff\xfe"])
def test_a_damaged_line_is_named(tmp_path, line):
    path = tmp_path / "trials.jsonl"
    path.write_bytes(b'{"name": "square/0", "result": 0}\n' + line.encode("latin1") + b"\n")
    with pytest.raises(ValueError, match=r"trials\.jsonl:2: is no row of a job"):
        JobRows(path)
