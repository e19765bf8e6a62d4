"""`tactile completion`: what a shell offers behind words that were typed."""

import re
import shutil
import subprocess
import sys

import pytest

from tactile_bringup import cli

pytest.importorskip("shtab", reason="needs shtab (the extra 'completion')")


@pytest.fixture(scope="module")
def script(tmp_path_factory):
    """The script for bash, in a file."""

    def write(shell):
        path = tmp_path_factory.mktemp("completion") / shell
        with path.open("w") as file, pytest.MonkeyPatch.context() as patch:
            patch.setattr("sys.stdout", file)
            assert cli.main(["completion", shell]) == 0
        return path

    return write


@pytest.fixture(scope="module")
def offered(script):
    """Words that bash offers behind a line; the last word of it has begun."""
    path = script("bash")
    (path.parent / "mine.yaml").touch()

    def complete(*words):
        line = " ".join(words)
        code = (
            f"source {path}; COMP_WORDS=({' '.join(words)} {'' if words[-1] else chr(39) * 2}); "
            f"COMP_CWORD={len(words) - 1}; COMP_LINE='{line}'; COMP_POINT={len(line)}; _shtab_tactile; "
            'printf "%s\\n" "${COMPREPLY[@]}"'
        )
        found = subprocess.run(
            ["bash", "-c", code], capture_output=True, text=True, cwd=path.parent, check=True
        )
        return found.stdout.split()

    return complete


def test_no_word_of_a_command_needs_what_only_its_work_does():
    """Where there is neither PyTorch nor onnx, all commands complete, and tell their options."""
    absent = """
import importlib.abc, sys
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name in ("torch", "onnx"):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
sys.meta_path.insert(0, Absent())
from tactile_bringup.cli import main
"""
    for words in (["completion", "bash"], ["train", "--help"], ["quantize", "--help"]):
        code = f"{absent}sys.exit(main({words}))"
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "words, expected",
    [
        (["tactile", "sim"], ["simulate"]),
        (["tactile", "arm", "ch"], ["check"]),
        (["tactile", "simulate", "surf"], ["surface_following"]),
        (["tactile", "simulate", "pushing", "--fid"], ["--fidelity"]),
        (["tactile", "launch", "object_tracking", "--scene", "tracking_c"], ["tracking_cube"]),
        (["tactile", "launch", "object_tracking", "--filter", "pa"], ["paper"]),
        (["tactile", "completion", "z"], ["zsh"]),
    ],
)
def test_commands_options_and_names_are_offered(offered, words, expected):
    assert offered(*words)[: len(expected)] == expected


def test_a_task_file_of_ones_own_is_offered_as_well(offered):
    assert {"pushing", "surface_following", "mine.yaml"} <= set(offered("tactile", "simulate", ""))


def test_every_command_is_known_to_both_shells(script):
    commands = [
        name
        for action in cli.command_line()._actions
        for name in (action.choices or {})
        if isinstance(action.choices, dict)
    ]
    assert len(commands) > 25
    for shell in ("bash", "zsh"):
        text = script(shell).read_text()
        assert all(re.search(rf"\b{name}\b", text) for name in commands)


@pytest.mark.skipif(not shutil.which("zsh"), reason="needs zsh")
def test_zsh_takes_it(script):
    assert subprocess.run(["zsh", "-n", script("zsh")], check=False).returncode == 0


def test_without_shtab_it_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(__import__("sys").modules, "shtab", None)
    assert cli.main(["completion", "bash"]) == 2
    assert "pip install shtab" in capsys.readouterr().err
