"""A node that is to run under a real-time priority."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FILTER = "tactile_ros.nodes.filter_node"


def may_have(priority: int) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except PermissionError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def test_a_node_computes_in_one_thread_unless_it_is_told_otherwise():
    """Threads of OpenBLAS that wait in circles for each other, at a priority, let nothing else run."""
    code = "import os, sys, tactile_ros.nodes; assert 'numpy' not in sys.modules; print(os.environ['%s'])"
    for given, found in ({}, "1"), ({"OPENBLAS_NUM_THREADS": "2"}, "2"):
        environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | given
        command = [sys.executable, "-c", code % "OPENBLAS_NUM_THREADS"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == found


def test_all_threads_of_a_node_have_its_priority_or_it_says_how_to_get_it(graph):
    process = graph.start(FILTER, {"priority": 5})
    threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
    if may_have(5):
        assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_FIFO}
        # the middleware's thread that spins for what others hold comes after them
        spins = {t: "dds.asyn" in Path(f"/proc/{process.pid}/task/{t}/comm").read_text() for t in threads}
        assert any(spins.values()) and not all(spins.values())
        assert {t: os.sched_getparam(t).sched_priority for t in threads} == {t: 5 - spins[t] for t in threads}
    else:
        assert "SCHED_FIFO 5 (rtprio in /etc/security/limits.conf allows it)" in graph.log(FILTER).read_text()


def test_all_threads_of_a_node_run_on_its_cores_or_it_says_that_they_cannot(graph):
    first = min(os.sched_getaffinity(0))
    process = graph.start(FILTER, {"cores": [first]})
    assert {
        frozenset(os.sched_getaffinity(int(thread))) for thread in os.listdir(f"/proc/{process.pid}/task")
    } == {frozenset({first})}


def test_a_core_that_is_not_there_is_told(graph):
    graph.start(FILTER, {"cores": [1023]})
    assert "this user may not have the cores 1023" in graph.log(FILTER).read_text()


@pytest.mark.parametrize("priority", [-1, 100])
def test_a_priority_that_there_is_not_is_refused(graph, priority):
    process = graph.start(FILTER, {"priority": priority}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1 and "must lie in [0, 99]" in graph.log(FILTER).read_text()
