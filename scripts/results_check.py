"""Run benchmarks again whose numbers depend on no clock, and compare them with those in docs/results/.

    python scripts/results_check.py [--only object_belief robust] [--pages filter.md]

A table of a page that stands below "By `python bench/...` of commit ...:" is what that command printed. Each
command runs once; of each table on the page every row is looked for in the output, by its text, and every
column by its head. A page may leave out rows and columns. Columns of times of computing are passed over. A
number may differ by one in its last digit and by 3 %, which other processors and libraries do; what the page
marks by ~ may differ by anything, what is
below 1e-15 is rounding.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

MADE = re.compile(r"^By `python (bench/[^`]+)` of ")
NUMBER = re.compile(r"[-+]?\d+(?:\.(\d+))?(?:e[-+]?\d+)?")
#: Units of columns that hold times of computing.
CLOCK = ("ns", "us", "ms", "times real time")
SHARE, ROUNDING = 0.03, 1e-15


@dataclass
class Block:
    """Heads and rows of one Markdown table."""

    heads: list[str]
    rows: list[list[str]] = field(default_factory=list)

    def keys(self) -> int:
        """How many of the first columns name a row: those without a number in any row, one at least."""
        texts = [k for k in range(len(self.heads)) if all(named(row[k]) for row in self.rows)]
        count = next((k for k in range(len(self.heads)) if k not in texts), len(self.heads))
        return max(1, count)


def named(cell: str) -> bool:
    """Whether a cell is a name rather than a measured number."""
    return re.fullmatch(r"[-+±.,/%\se\d]+", cell) is None


def cells(line: str) -> list[str]:
    """Of a row, without emphasis."""
    return [cell.strip().replace("**", "").replace("`", "") for cell in line.strip().strip("|").split("|")]


def tables(text: str) -> Iterator[tuple[str, Block]]:
    """Each table below a line that says how it was made, with the command."""
    command, block = "", None
    for line in [*text.splitlines(), ""]:
        made = MADE.match(line)
        if made:
            command = made[1]
        if line.startswith("|"):
            if block is None:
                block = Block(cells(line))
            elif not re.fullmatch(r"[|\s:-]+", line):
                block.rows.append(cells(line))
        elif block is not None:
            if command:
                yield command, block
            command, block = command if not line else "", None
        elif line and not made:
            command = ""


def same(said: str, found: str) -> bool:
    """Whether two cells agree: the same words, and numbers within what other machines change."""
    if said.startswith("~"):  # an unstable loop, say
        return True
    if NUMBER.sub("#", said) != NUMBER.sub("#", found):
        return False
    for old, new in zip(NUMBER.finditer(said), NUMBER.finditer(found), strict=True):
        a, b = float(old[0]), float(new[0])
        mantissa, _, power = old[0].partition("e")
        digits = len(mantissa.partition(".")[2])
        unit = 10.0 ** (int(power or 0) - digits)
        if max(abs(a), abs(b)) > ROUNDING and abs(a - b) > 1.01 * unit + SHARE * abs(a):
            return False
    return True


def differences(page: Block, output: list[Block]) -> list[str]:
    """What a page's table says otherwise than the output; `output` are the command's tables."""
    fitting = [block for block in output if set(page.heads) <= set(block.heads)]
    if not fitting:
        return [f"no table of the output has the columns {page.heads}"]
    keys, found = page.keys(), []
    for row in page.rows:
        label = " | ".join(row[:keys])
        matches = [
            (block, other)
            for block in fitting
            for other in block.rows
            if all(same(row[k], other[block.heads.index(page.heads[k])]) for k in range(keys))
        ]
        if not matches:
            found.append(f"{label}: not in the output")
            continue
        wrong = [_wrong(page.heads, row, block.heads, other) for block, other in matches]
        if all(wrong):
            found.append(f"{label}: " + min(wrong, key=len))
    return found


def _wrong(heads: list[str], row: list[str], other_heads: list[str], other: list[str]) -> str:
    """The cells of a row that differ, as a sentence; empty if none does."""
    off = []
    for head, said in zip(heads, row, strict=True):
        now = other[other_heads.index(head)]
        if not any(head == unit or head.endswith((f" {unit}", f"[{unit}]")) for unit in CLOCK) and not same(
            said, now
        ):
            off.append(f"{head} is {now}, the page says {said}")
    return "; ".join(off)


def run(command: str) -> list[Block]:
    """The tables that a command prints; RuntimeError where it fails."""
    done = subprocess.run(
        [sys.executable, *shlex.split(command)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip()).splitlines()[-1:]
        raise RuntimeError(f"python {command} ended with {done.returncode}: {''.join(last)}")
    return [block for _, block in tables(done.stdout)]


def main() -> int:
    """Compare; the exit status says whether all agree."""
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    arguments.add_argument("--only", nargs="+", default=[], help="commands that hold one of these words")
    arguments.add_argument("--pages", nargs="+", default=[], help="files of docs/results (default: all)")
    given = arguments.parse_args()
    wanted: dict[str, list[tuple[str, Block]]] = {}
    for page in sorted((ROOT / "docs/results").glob("*.md")):
        if given.pages and page.name not in given.pages:
            continue
        for command, block in tables(page.read_text()):
            if not given.only or any(word in command for word in given.only):
                wanted.setdefault(command, []).append((page.name, block))
    if not wanted:
        print("no table in docs/results is by such a command", file=sys.stderr)
        return 2
    failed = 0
    for command, blocks in wanted.items():
        started, wrong = time.monotonic(), []
        try:
            output = run(command)
            wrong = [f"{name}: {text}" for name, block in blocks for text in differences(block, output)]
        except RuntimeError as error:
            wrong = [str(error)]
        rows = sum(len(block.rows) for _, block in blocks)
        state = "DIFFERS" if wrong else "agrees"
        print(f"{state:8} {rows:3d} rows  {time.monotonic() - started:5.0f} s  {command}", flush=True)
        print("".join(f"         {text}\n" for text in wrong), end="")
        failed += bool(wrong)
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
