"""Every benchmark starts, and numbers on the results pages come out of them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "scripts"))

import results_check

OTHERS = ("other_package/plugin_mistakes", "records/damage_everywhere", "emulated/fusion_neon")

#: All in one process: each takes longer to import its libraries than to say what it takes.
EACH = """
import contextlib, io, runpy, sys, traceback
for path in sys.argv[1:]:
    sys.argv, said, before = [path, "--help"], io.StringIO(), list(sys.path)
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            runpy.run_path(path, run_name="__main__")
        print(path, "did not stop at --help")
    except SystemExit as ended:
        if ended.code or "usage:" not in said.getvalue():
            print(path, "ended with", ended.code, said.getvalue()[-300:])
    except BaseException:
        print(path, traceback.format_exc(limit=-1))
    sys.path[:] = before
"""


def scripts(root: Path) -> list[str]:
    """What a person starts: all of bench/ that is no library, and its like beside the tests."""
    found = [path for path in sorted((root / "bench").rglob("*.py")) if "__main__" in path.read_text()]
    others = ["docs/images/simulator_pictures.py", "scripts/results_check.py"]
    others += [f"test/{name}.py" for name in OTHERS]
    return [str(path) for path in (*found, *(root / name for name in others))]


def test_every_benchmark_says_what_it_takes(root: Path):
    files = scripts(root)
    assert len(files) > 25
    environment = os.environ | {"PYTHONSAFEPATH": "1"}  # as scripts/env.sh has it
    done = subprocess.run(
        [sys.executable, "-c", EACH, *files], capture_output=True, text=True, env=environment, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""


def test_a_benchmark_says_in_a_sentence_what_it_lacks(root: Path, tmp_path: Path):
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['mpmath'] = None\n")
    command = [sys.executable, str(root / "bench/fusion/accuracy.py")]
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=600)
    assert done.returncode == 1
    assert "accuracy.py needs mpmath: pip install" in done.stderr and "Traceback" not in done.stderr


@pytest.mark.parametrize("said, found, alike", [
    ("0.39 (0.08)", "0.39 (0.08)", True), ("0.39", "0.40", True), ("0.39", "0.42", False),
    ("120.0", "123.0", True), ("120.0", "126.0", False), ("2e-12", "3e-12", True), ("2e-12", "5e-12", False),
    ("5e-16", "1e-17", True), ("failed", "1.20", False), ("3.63 ± 2.56", "3.63 ± 2.9", False),
])  # fmt: skip
def test_numbers_agree_within_what_other_machines_change(said: str, found: str, alike: bool):
    assert results_check.same(said, found) is alike


PAGE = """
By `python bench/a.py` of commit 1234567 (CPU); seed 0:

| contacts | position | us |
| --- | --- | --- |
| **one** | 1.00 | 7 |
| two | {two} | 9 |

| unrelated | table |
| --- | --- |
| a | b |

Prose ends it.

| contacts | position |
| --- | --- |
| nobody's | 3.00 |
"""


def test_a_number_that_a_page_has_wrong_is_named_and_times_are_passed_over():
    output = [block for _, block in results_check.tables(PAGE.format(two="0.63"))]
    assert [block.rows[0][0] for block in output] == ["one", "a"]
    assert results_check.differences(output[0], output) == []
    wrong = next(
        block for _, block in results_check.tables(PAGE.format(two="0.73").replace("| 9 |", "| 90 |"))
    )
    assert results_check.differences(wrong, output) == ["two: position is 0.63, the page says 0.73"]
    wrong.rows.append(["three", "0.1", "1"])
    assert "three: not in the output" in results_check.differences(wrong, output)


@pytest.mark.slow
def test_a_sample_of_the_results_comes_out_again(root: Path):
    command = [
        sys.executable,
        str(root / "scripts/results_check.py"),
        "--only",
        "object_belief",
        "fusion/accuracy",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count("agrees") == 2
