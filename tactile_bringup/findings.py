"""Findings of a check that a person reads line by line: what is right, wrong, or for them to look at."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass

from tactile_base.console import say

OK, LOOK, FAILED = "ok", "look", "FAILED"
_STYLES = {FAILED: "red", LOOK: "yellow"}


@dataclass(frozen=True)
class Finding:
    """What was found; `verdict` is one of OK, LOOK (a person has to) and FAILED."""

    verdict: str
    what: str
    found: str


def show(findings: Iterable[Finding]) -> int:
    """Print each as soon as it is known, and how many there are of each; 1 where one has failed, else 0."""
    from rich.console import Console

    console, counts = Console(), Counter[str]()
    for finding in findings:
        counts[finding.verdict] += 1
        say(console, f"{finding.verdict:7s} {finding.what}: {finding.found}", _STYLES.get(finding.verdict))
    say(console, ", ".join(f"{counts[verdict]} {verdict}" for verdict in (OK, LOOK, FAILED)))
    return 1 if counts[FAILED] else 0
