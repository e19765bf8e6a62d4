"""How long finished trainings took, and how right the command was about it on the way.

    python bench/perception/training_time.py RUN [RUN ...]

RUN is a run folder of `tactile train` or a folder of them. After each epoch the command says what is left:
time gone and time left are what it then expected for the whole, which is compared with what it took.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

EPOCHS, RESULT = "epochs.csv", "result.json"


def expected_whole(run: Path) -> np.ndarray:
    """What was expected after each epoch for the whole run, s; the last is what it took."""
    with (run / EPOCHS).open() as file:
        rows = list(csv.DictReader(file))
    gone = np.cumsum([float(row["seconds"]) for row in rows])
    return gone + np.array([float(row["seconds_left"]) for row in rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    folders = [found.parent for path in parser.parse_args().runs for found in sorted(path.rglob(RESULT))]
    if not folders:
        parser.error("no finished run in there")
    print(f"{'run':40s} epochs  minutes  s/epoch   expected / taken: after the first epoch, worst")
    for run in folders:
        whole = expected_whole(run)
        ratio = whole / whole[-1]
        worst = ratio[np.abs(ratio - 1.0).argmax()]
        print(
            f"{str(run)[-40:]:40s} {len(whole):6d} {whole[-1] / 60:8.1f} {whole[-1] / len(whole):8.1f}"
            f"   {ratio[0]:.2f}, {worst:.2f}"
        )


if __name__ == "__main__":
    main()
