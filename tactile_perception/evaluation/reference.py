"""The paper's results, to compare with: `config/perception/tables_lloyd_lepora.yaml`."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile_base.config_paths import config_path
from tactile_base.yaml_file import read_yaml

Array = NDArray[np.float64]
_FILE = "perception/tables_lloyd_lepora.yaml"


@dataclass(frozen=True)
class ReferenceTables:
    """Mean absolute errors (6,) in mm and rad.

    Attributes
    ----------
    networks : loss and errors by kind of network
    filter : errors by sigma_psi in mm and degrees
    """

    networks: dict[str, tuple[float, Array]] = field(default_factory=dict)
    filter: dict[float, Array] = field(default_factory=dict)


def paper_tables() -> ReferenceTables:
    """The paper's tables; `SettingError` or `OSError` if the file is not as it was shipped."""
    root = read_yaml(config_path(_FILE))
    root.allow("networks", "filter")
    filtered = root.section("filter")
    return ReferenceTables(
        networks={
            kind: (section.number("loss"), np.array(section.numbers("mae", 6)))
            for kind, section in root.sections("networks").items()
        },
        filter={float(key): np.array(filtered.numbers(key, 6)) for key in filtered.values},
    )
