"""The suite goes on after a process of its own has died."""

import os
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pytest

FILES = {
    "test_done.py": "def test_first(): pass\ndef test_second(): pass\ndef test_third(): pass\n",
    "test_dies.py": "import os\ndef test_before(): pass\ndef test_end(): os._exit(1)\ndef test_x(): pass\n",
    "test_alone.py": "def test_alone(): pass\n",
    "test_dies_alone.py": "import os\ndef test_end(): os._exit(1)\n",
    "test_last.py": "def test_last(): pass\n",
}


@pytest.mark.parametrize("processes", [1, 2, 3])
def test_process_that_dies_costs_one_test(tmp_path: Path, root: Path, processes: int):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    for name in ("conftest.py", "by_file.py"):
        shutil.copy(root / "test" / name, tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\npythonpath = .\n")
    command = [sys.executable, "-m", "pytest", "-q", f"-n{processes}", "--dist", "loadfile"]
    result = subprocess.run(
        command,
        cwd=tmp_path,
        env={name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert "2 failed, 7 passed" in result.stdout, result.stdout + result.stderr


def test_process_that_cannot_be_given_tests_any_more_ends_nothing(root: Path, monkeypatch):
    """It has died, and nobody has been told yet."""
    monkeypatch.syspath_prepend(root / "test")
    from by_file import ByFile, LoadFileScheduling

    asked = []

    def closed(self, node):
        asked.append(node)
        raise OSError("cannot send (already closed?)")

    monkeypatch.setattr(LoadFileScheduling, "_reschedule", closed)
    scheduling, node = object.__new__(ByFile), Mock(shutting_down=False)
    scheduling.assigned_work = {node: {}}
    scheduling._reschedule(node)
    assert asked == [node]
