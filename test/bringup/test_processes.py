"""Children are stopped, reported and never left behind."""

import fcntl
import io
import mmap
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tactile_bringup.launching import keeper, processes, shared_memory
from tactile_bringup.launching.processes import ProcessDied, ProcessGroup, describe_exit, memory_kills, tail

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]
POLITE = "import time\ntry:\n time.sleep(60)\nexcept KeyboardInterrupt:\n print('bye', flush=True)"
DEAF = """import signal, time
for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, signal.SIG_IGN)
print("up", flush=True)
time.sleep(60)"""


def python(code: str) -> list[str]:
    return [sys.executable, "-S", "-c", code]


def wait_for(condition, timeout_s: float = 30.0) -> bool:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.02)
    return False


def runs(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.fixture
def group():
    with ProcessGroup(grace_s=1.0, kill_after_s=0.3) as group:
        yield group


def test_a_child_that_ends_is_reported_with_name_exit_code_and_the_last_lines(group, tmp_path):
    log = tmp_path / "filter.log"
    group.start(
        "arm/filter", python("print('no calibration in sight'); raise SystemExit(3)"), os.environ, log
    )
    with pytest.raises(ProcessDied) as caught:
        assert wait_for(lambda: group.check())
    message = str(caught.value)
    assert "arm/filter ended with exit code 3" in message
    assert str(log) in message and "no calibration in sight" in message


def test_a_child_killed_by_a_signal_is_reported_by_the_signals_name(group, tmp_path):
    child = group.start("sim", python(POLITE), os.environ, tmp_path / "sim.log")
    child.process.kill()
    with pytest.raises(ProcessDied, match="sim was killed by SIGKILL"):
        wait_for(lambda: group.check())


def test_a_healthy_child_passes_the_check(group, tmp_path):
    group.start("sim", python(POLITE), os.environ, tmp_path / "sim.log")
    group.check()


def test_stopping_lets_a_child_finish_after_an_interrupt(group, tmp_path):
    child = group.start("polite", python("print('up', flush=True)\n" + POLITE), os.environ, tmp_path / "log")
    assert wait_for(lambda: "up" in child.log.read_text())
    (report,) = group.stop()
    assert (report.exit_code, report.escalated_to) == (0, "")
    assert "bye" in child.log.read_text()


def test_stopping_kills_a_child_that_ignores_signals(group, tmp_path):
    child = group.start("deaf", python(DEAF), os.environ, tmp_path / "log")
    assert wait_for(lambda: "up" in child.log.read_text())
    started = time.monotonic()
    (report,) = group.stop()
    assert (report.exit_code, report.escalated_to) == (-signal.SIGKILL, "SIGKILL")
    assert 1.3 <= time.monotonic() - started < 4.0


def test_stopping_urgently_does_not_wait(group, tmp_path):
    child = group.start("deaf", python(DEAF), os.environ, tmp_path / "log")
    assert wait_for(lambda: "up" in child.log.read_text())
    started = time.monotonic()
    group.stop(urgent=True)
    assert time.monotonic() - started < 1.0


def test_children_stop_in_the_reverse_of_their_order_and_only_those_that_are_named(group, tmp_path):
    for name in ("recorder", "sim", "controller"):
        group.start(name, python(POLITE), os.environ, tmp_path / f"{name}.log")
    assert [report.name for report in group.stop(["sim", "controller"])] == ["controller", "sim"]
    assert list(group.children) == ["recorder"]


def test_what_a_child_started_itself_ends_with_it(group, tmp_path):
    start = f"print(subprocess.Popen({python(DEAF)!r}).pid, flush=True)"
    code = f"import subprocess, time\n{start}\ntime.sleep(60)"
    child = group.start("parent", python(code), os.environ, tmp_path / "log")
    assert wait_for(lambda: child.log.read_text().strip())
    grandchild = int(child.log.read_text().split()[0])
    group.stop()
    assert wait_for(lambda: not runs(grandchild))


def test_two_children_of_one_name_are_refused(group, tmp_path):
    group.start("sim", python(POLITE), os.environ, tmp_path / "a")
    with pytest.raises(ValueError, match="a process named sim runs already"):
        group.start("sim", python(POLITE), os.environ, tmp_path / "b")


def test_a_missing_program_is_an_error_at_once(group, tmp_path):
    with pytest.raises(FileNotFoundError, match="/no/such/program"):
        group.start("camera", ["/no/such/program"], os.environ, tmp_path / "log")


@pytest.mark.parametrize("child_code", [POLITE, DEAF], ids=["polite", "ignores signals"])
def test_a_killed_parent_leaves_no_child(tmp_path, child_code):
    code = f"""
import os, time
from pathlib import Path
from tactile_bringup.launching.processes import ProcessGroup
group = ProcessGroup()
folder = Path({str(tmp_path)!r})
pids = [group.start(n, {python(child_code)!r}, os.environ, folder / n).process.pid for n in "ab"]
time.sleep(0.3)
print(*pids, group._keeper._process.pid, flush=True)
time.sleep(60)
"""
    parent = subprocess.Popen(
        python(code), env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdout is not None
    pids = [int(pid) for pid in parent.stdout.readline().split()]
    assert len(pids) == 3 and all(map(runs, pids))
    parent.kill()
    parent.wait()
    assert wait_for(lambda: not any(map(runs, pids)))


def test_a_keeper_that_comes_to_run_late_removes_what_was_made_since_it_was_started(monkeypatch):
    since = []
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(keeper, "end", lambda groups: None)
    monkeypatch.setattr(shared_memory, "remove_orphans", since.append)
    monkeypatch.setattr(sys, "argv", ["keeper", "1234"])
    monkeypatch.setattr(sys, "stdin", io.StringIO("watch 1\nwatch 2\nrelease 1\n"))
    keeper.main()
    assert since == [1234]


def test_exit_codes_in_words():
    assert describe_exit(1) == "ended with exit code 1"
    assert describe_exit(-11) == "was killed by SIGSEGV"


@pytest.mark.parametrize(
    ("before", "now", "cause"),
    [
        (3, 4, ", probably by the kernel because memory ran out (`dmesg` names whom it killed; `free -h`)"),
        (3, 3, ", by a person or a program: not by the kernel for want of memory"),
        (None, None, ""),
    ],
)
def test_of_a_process_that_was_killed_it_is_said_whether_memory_ran_out(monkeypatch, before, now, cause):
    monkeypatch.setattr(processes, "_MEMORY_KILLS", before)
    monkeypatch.setattr(processes, "memory_kills", lambda: now)
    assert describe_exit(-9) == f"was killed by SIGKILL{cause}"
    assert describe_exit(-11) == "was killed by SIGSEGV"


def test_the_kernels_count_of_processes_killed_for_want_of_memory_is_read(tmp_path):
    counters = tmp_path / "vmstat"  # as of Linux 6: one `name number` a line
    counters.write_text("nr_free_pages 5\noom_kill_disable 1\noom_kill 7\nnuma_pte_updates 0\n")
    assert memory_kills(counters) == 7
    counters.write_text("nr_free_pages 5\n")  # before Linux 4.13
    assert memory_kills(counters) is None and memory_kills(tmp_path / "none") is None


def test_the_tail_of_a_log_is_its_last_lines(tmp_path):
    log = tmp_path / "log"
    assert tail(log) == "(no log)"
    log.write_text("")
    assert tail(log) == "(it wrote nothing)"
    log.write_text("\n".join(str(n) for n in range(100)))
    assert tail(log, 2) == "98\n99"


def made(*paths):
    """Files of a while ago."""
    for path in paths:
        path.touch()
        os.utime(path, (time.time() - 10.0,) * 2)


@pytest.fixture(params=["by the kernel's list", "by a lock of its own, as in a container"])
def look(request, monkeypatch):
    whole = request.param.startswith("by the kernel")
    monkeypatch.setattr(
        shared_memory, "_ALL_PROCESSES", os.readlink("/proc/self/ns/pid") if whole else "elsewhere"
    )


def test_only_segments_without_a_living_owner_are_removed(tmp_path, look):
    data = "fastdds_0123456789abcdef"
    names = [data, data + "_el", "fastdds_port7000", "sem.fastdds_port7000_mutex"]
    for name in [*names, "fastdds_fedcba9876543210", "fastdds_fedcba9876543210_el", "somebody_elses"]:
        made(tmp_path / name)
    lock_file = str(tmp_path / "fastdds_fedcba9876543210_el")
    lock = f"import fcntl, time\nf = open({lock_file!r})\nfcntl.flock(f, 2)\n"
    owner = subprocess.Popen(python(lock + "print('up', flush=True)\ntime.sleep(60)"), stdout=subprocess.PIPE)
    try:
        assert owner.stdout is not None and owner.stdout.readline()
        assert shared_memory.remove_orphans(folder=tmp_path) == names
        assert shared_memory.segments(tmp_path) == {"fastdds_fedcba9876543210", "fastdds_fedcba9876543210_el"}
    finally:
        owner.kill()
        owner.wait()
    assert len(shared_memory.remove_orphans(folder=tmp_path)) == 2
    assert (tmp_path / "somebody_elses").exists()


def test_segments_older_than_the_run_stay(tmp_path):
    made(tmp_path / "fastdds_0123456789abcdef")
    assert shared_memory.remove_orphans(time.time_ns() - 10**9, folder=tmp_path) == []


def test_a_segment_that_its_maker_may_not_have_locked_yet_stays(tmp_path):
    (tmp_path / "fastdds_0123456789abcdef_el").touch()
    assert shared_memory.remove_orphans(folder=tmp_path) == []


def test_a_look_takes_no_lock_which_a_node_that_starts_would_miss(tmp_path, monkeypatch):
    monkeypatch.setattr(shared_memory, "_ALL_PROCESSES", os.readlink("/proc/self/ns/pid"))
    monkeypatch.delattr(fcntl, "flock")
    made(tmp_path / "fastdds_port7411_el")
    assert shared_memory.remove_orphans(folder=tmp_path) == ["fastdds_port7411_el"]


def test_a_dead_segment_goes_though_a_reader_still_maps_it(tmp_path):
    names = ["fastdds_0123456789abcdef", "fastdds_0123456789abcdef_el", "fastdds_port7000"]
    for name in names:
        (tmp_path / name).write_bytes(b"\0")
        made(tmp_path / name)
    maps = [mmap_of(tmp_path / name) for name in ("fastdds_0123456789abcdef", "fastdds_port7000")]
    assert shared_memory.remove_orphans(folder=tmp_path) == names[:2]
    for mapped in maps:
        mapped.close()
    assert shared_memory.remove_orphans(folder=tmp_path) == names[2:]


def test_two_who_look_at_once_both_see_that_a_segment_is_dead(tmp_path, monkeypatch):
    dead = [tmp_path / "fastdds_0123456789abcdef", tmp_path / "fastdds_0123456789abcdef_el"]
    made(*dead)
    monkeypatch.setattr(shared_memory, "_ALL_PROCESSES", "elsewhere")
    seen, flock = [], fcntl.flock

    def look_again(*arguments):
        flock(*arguments)
        monkeypatch.setattr(fcntl, "flock", flock)
        seen.append(shared_memory.orphans(folder=tmp_path))

    monkeypatch.setattr(fcntl, "flock", look_again)
    assert shared_memory.orphans(folder=tmp_path) == dead
    assert seen == [dead]


def mmap_of(path: Path) -> mmap.mmap:
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 1)
