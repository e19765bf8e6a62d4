"""What runs beside arms gives way to them, also where time is shared out by session first."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tactile_base.priority import NICENESS, give_way

AUTOGROUP = Path("/proc/self/autogroup")
OWN = "from tactile_base.priority import give_way; give_way(); print('there', flush=True); input()"


@pytest.mark.parametrize("told", [True, False], ids=["another", "itself"])
@pytest.mark.parametrize("leads", [True, False])
def test_a_process_gives_way_and_the_session_that_it_leads(told, leads):
    script = "print('there', flush=True); input()" if told else OWN
    before = AUTOGROUP.read_text() if AUTOGROUP.exists() else ""
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=leads
    ) as process:
        process.stdout.readline()
        if told:
            give_way(process.pid)
        assert os.getpriority(os.PRIO_PROCESS, process.pid) >= NICENESS
        if leads and before:
            assert Path(f"/proc/{process.pid}/autogroup").read_text().endswith(f"nice {NICENESS}\n")
        process.communicate(b"\n")
    assert (AUTOGROUP.read_text() if before else "") == before
