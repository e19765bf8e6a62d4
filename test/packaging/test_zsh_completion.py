"""Completion in a zsh that somebody types in, after `. scripts/env.sh`: whether or not .zshrc set it up."""

import os
import pty
import re
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tactile_bringup import cli

pytest.importorskip("shtab", reason="needs shtab (the extra 'completion')")
pytestmark = pytest.mark.skipif(not shutil.which("zsh"), reason="needs zsh (Debian, Ubuntu: apt install zsh)")

SCRIPTS = Path(__file__).parents[2] / "scripts"
PATIENCE = 120.0  # s
PROMPT = "ready> "


@pytest.fixture
def built(tmp_path, monkeypatch, capsys):
    """A folder with what env.sh wants of a build."""
    python = tmp_path / ".venv/bin/python"
    functions = tmp_path / "install/share/zsh/site-functions"
    ours = tmp_path / "install/lib/python3/site-packages"
    libraries = tmp_path / ".venv/lib/python3/site-packages/ros_some.libs"
    for folder in (python.parent, functions, ours, libraries, tmp_path / "scripts"):
        folder.mkdir(parents=True)
    python.symlink_to(sys.executable)
    shutil.copy(SCRIPTS / "env.sh", tmp_path / "scripts")
    assert cli.main(["completion", "zsh"]) == 0
    (functions / "_tactile").write_text(capsys.readouterr().out)
    return tmp_path


class Zsh:
    """An interactive zsh in a pseudo-terminal, with this .zshrc."""

    def __init__(self, folder: Path, zshrc: str) -> None:
        (folder / ".zshrc").write_text(f"PS1='{PROMPT}'; unsetopt zle_bracketed_paste\n{zshrc}\n")
        self._terminal, theirs = pty.openpty()
        variables = {"PATH": os.environ["PATH"], "TERM": "dumb", "ZDOTDIR": str(folder), "HOME": str(folder)}
        self.process = subprocess.Popen(
            ["zsh", "-d", "-i"], stdin=theirs, stdout=theirs, stderr=theirs, cwd=folder, env=variables,
            start_new_session=True,
        )  # fmt: skip
        os.close(theirs)
        self.said = ""
        self.shows(PROMPT)

    def types(self, text: str) -> None:
        self.said = ""
        os.write(self._terminal, text.encode())

    def shows(self, pattern: str) -> bool:
        """Whether something appears in time."""
        end = time.monotonic() + PATIENCE
        while not (found := re.search(pattern, self.said, re.DOTALL)) and time.monotonic() < end:
            if select.select([self._terminal], [], [], 0.1)[0]:
                self.said += os.read(self._terminal, 4096).decode(errors="replace")
        return found is not None

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        os.close(self._terminal)


@pytest.mark.parametrize("zshrc", ["autoload -Uz compinit && compinit -u -D", ""], ids=["compinit", "bare"])
def test_commands_and_tasks_are_completed_as_typed(built, zshrc):
    zsh = Zsh(built, zshrc)
    try:
        zsh.types(". scripts/env.sh; echo d''one\n")  # a tab that is typed ahead would be one
        assert zsh.shows(f"done\r\n.*{PROMPT}"), zsh.said
        zsh.types("tactile simul\t")
        assert zsh.shows("simulate "), zsh.said
        zsh.types("surf\t")
        assert zsh.shows("surface_following"), zsh.said
    finally:
        zsh.close()
