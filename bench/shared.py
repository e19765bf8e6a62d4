"""What all benchmarks share: the command line, extras that `make` does not install, times, and tables.

A table says above itself how it was made, in the form that docs/results/ keeps and `make results-check`
reads, so that a page is pasted from what was measured.
"""

from __future__ import annotations

import argparse
import importlib.util
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_base.origin import processor

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]


def parser(text: str) -> argparse.ArgumentParser:
    """A command line that shows the whole text of a module."""
    first, _, rest = text.partition("\n")
    return argparse.ArgumentParser(
        description=first, epilog=rest, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def needs(install: str, *modules: str) -> None:
    """End with a sentence where modules are missing that `make` does not install.

    Raises
    ------
    SystemExit
        It says what is missing and the command that installs it.
    """
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise SystemExit(f"{Path(sys.argv[0]).name} needs {', '.join(missing)}: {install}")


def made_by() -> str:
    """The command that runs, the commit, the processor and Python: what a table needs to be made again."""
    script = Path(sys.argv[0]).resolve()
    name = script.relative_to(ROOT) if script.is_relative_to(ROOT) else script
    command = shlex.join(["python", str(name), *sys.argv[1:]])
    return f"`{command}` of {_commit()} ({processor()}, Python {platform.python_version()})"


def _commit() -> str:
    git = ["git", "-C", str(ROOT)]
    try:
        commit = subprocess.check_output(
            [*git, "rev-parse", "--short", "HEAD"], text=True, stderr=subprocess.DEVNULL
        )
    except (OSError, subprocess.CalledProcessError):
        return "sources outside git"
    code = ["--", ":/", ":(exclude)docs"]  # what pages say changes no number
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", *code], cwd=ROOT, check=False).returncode
    return f"commit {commit.strip()}" + ", changed" * bool(changed)


class Table:
    """A Markdown table that is printed row by row, below how it was made.

    Parameters
    ----------
    columns : heads of the columns
    statistic : what its numbers are: "best of 200", "means over seeds 0 to 4"
    timed : whether all of it depends on the clock, so that nobody can compare it with a later run
    """

    def __init__(self, columns: Sequence[str], statistic: str, timed: bool = False) -> None:
        print(f"\n{'Timed b' if timed else 'B'}y {made_by()}; {statistic}:\n")
        self._width = len(columns)
        self.row(*columns)
        print("|" + " --- |" * self._width, flush=True)

    def row(self, *cells: Any) -> None:
        """Print a row; ValueError where it has more or fewer cells than the table columns."""
        if len(cells) != self._width:
            raise ValueError(f"{len(cells)} cells in a table of {self._width} columns: {cells}")
        print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def taken(call: Callable[[int], Any], count: int, clock: Callable[[], int] = time.perf_counter_ns) -> Array:
    """Microseconds (count,) of calls, which get their number."""
    found = np.empty(count)
    for k in range(count):
        start = clock()
        call(k)
        found[k] = (clock() - start) / 1e3
    return found


def best(calls: dict[str, Callable[[], Any]], rounds: int, each: Callable[[str], int]) -> dict[str, float]:
    """Shortest mean time of a short series of calls, us; rounds go through all in turn: all see one load."""
    found = dict.fromkeys(calls, float("inf"))
    for _ in range(rounds):
        for name, call in calls.items():
            count = each(name)
            whole = taken(lambda _, call=call, count=count: [call() for _ in range(count)], 1)[0]
            found[name] = min(found[name], float(whole) / count)
    return found


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Beside so many processes that never rest."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for other in others:
            other.kill()
            other.wait()


def percentiles(values: Iterable[float], *which: float) -> list[float]:
    """Percentiles, median and 99 % where none are named."""
    return [float(value) for value in np.percentile(list(values), which or (50, 99))]


def random_covariance(rng: np.random.Generator, sigma: Array, spread: float) -> Array:
    """Standard deviations around sigma within factors of 10**spread, correlated if the spread is not zero."""
    factor = np.eye(6) + (spread > 0) * 0.5 * np.tril(rng.uniform(-1, 1, (6, 6)), -1)
    correlated = factor @ factor.T
    scale = sigma * 10.0 ** rng.uniform(-spread, spread, 6) / np.sqrt(np.diag(correlated))
    result = correlated * np.outer(scale, scale)
    return 0.5 * (result + result.T)


#: Standard deviations of an estimate of a contact, m and rad.
SIGMA = np.array([5e-4, 5e-4, 2e-4, 8e-3, 8e-3, 2e-2])


def contact_pair(rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Means and covariances of two estimates of one contact, as the filter meets them."""
    from tactile_geometry import se3

    mean = se3.exp(0.1 * rng.normal(size=6))
    other = se3.exp(SIGMA * rng.normal(size=6)) @ mean
    return mean, random_covariance(rng, SIGMA, 0.3), other, random_covariance(rng, SIGMA, 0.3)
