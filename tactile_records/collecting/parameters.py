"""`collect_params.json`: what a data folder was made with, so that other data do not mix into it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tactile_base.input_file import parse_json, read_text
from tactile_base.whole_file import whole_file
from tactile_perception.datasets.layout import PARAMETERS_NAME, DatasetError


def check_same_run(folder: Path, parameters: dict[str, Any]) -> None:
    """Write the parameters beside the data; refuse to add to data that were made with other ones.

    Raises `DatasetError` with the names of the parameters that differ.
    """
    path = folder / PARAMETERS_NAME
    parameters = json.loads(json.dumps(parameters))
    if path.exists():
        try:
            found = parse_json(read_text(path))
        except ValueError as error:
            raise DatasetError(f"{path}: cannot be read ({error}); remove the folder or this file") from error
        if found != parameters:
            names = parameters.keys() | found.keys()
            other = ", ".join(sorted(name for name in names if parameters.get(name) != found.get(name)))
            raise DatasetError(f"{folder}: was made with another {other}; remove it or choose another folder")
        return
    folder.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(parameters, indent=2) + "\n")
