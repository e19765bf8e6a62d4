"""`tactile new`: what it writes passes its own tests, and what it cannot write it says."""

import os
import subprocess
import sys

import pytest
from other_package import as_installed

from tactile_bringup import cli
from tactile_bringup.new_package import ENTRY_POINTS


@pytest.mark.parametrize(
    "kind",
    [
        pytest.param(kind, marks=pytest.mark.live if kind in ("arm", "camera") else ())
        for kind in ENTRY_POINTS
    ],
)
def test_a_new_package_passes_its_own_tests(kind, tmp_path, capfd):
    assert cli.main(["new", kind, "my_own", "--folder", str(tmp_path)]) == 0
    assert f"pip install -e {tmp_path / 'my_own'}" in capfd.readouterr().out
    path = os.pathsep.join((as_installed(tmp_path / "my_own"), os.environ.get("PYTHONPATH", "")))
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(tmp_path / "my_own")],
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stdout[-3000:]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["shape", "My-Bowl"], "name 'My-Bowl': must be lower-case letters, digits and _"),
        (["shape", "here"], "here: File exists"),
    ],
)
def test_what_cannot_be_written_is_said(words, said, tmp_path, capfd):
    (tmp_path / "here").mkdir()
    assert cli.main(["new", *words, "--folder", str(tmp_path)]) == 2
    assert said in capfd.readouterr().err
