"""What one run of a replay is to be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tactile_filter.bayes_filter import FilterSettings


@dataclass(frozen=True)
class Plan:
    """One run: its name, the bag that it writes, and the settings of each arm's filter.

    `given` are the names of settings that do not follow the changes in the recording.
    """

    name: str
    bag: Path
    settings: Mapping[str, FilterSettings]
    given: frozenset[str] = frozenset()
