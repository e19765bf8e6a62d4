"""Learning a sensor: contacts in rounds, a network after each, until a promise is kept on contacts held back.

In a folder lie `contacts/` (to learn from) and `held_back/` (a fifth of all, which no network learns from),
and of each round, named by all contacts that there were, its network's run and what became of it. While the
arm makes the contacts of a round, the network of the last one is trained beside it, at lower priority. All of
it is on disk at any time: whoever asks for the same again goes on from there::

    learning = Learning(folder, (100, 200, 500), promise, collect, ["--config", "few_contacts.yaml"])
    rounds = learning.run()
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_base.input_file import parse_json, read_text
from tactile_base.priority import give_way
from tactile_base.settings import SettingError, unknown_name
from tactile_base.whole_file import whole_file
from tactile_base.yaml_file import name_and_value
from tactile_perception.estimating.contact_model import FORCES, POSE, ContactModel
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.model_metadata import RESULT_NAME
from tactile_perception.estimating.preprocessing import as_input
from tactile_perception.evaluation.evaluate import EvaluationData, ModelResult, evaluate, load_data
from tactile_perception.evaluation.metrics import LEVELS, euler_error
from tactile_perception.evaluation.models import open_models

Array = NDArray[np.float64]

Parts = Mapping[str, tuple[tuple[int, ...], str]]

#: What is promised by name: of which components of the Euler contact pose, and its unit.
PARTS: Parts = {
    "depth": ((2,), "mm"),
    "tilt": ((3, 4), "deg"),
    "shear": ((0, 1), "mm"),
    "twist": ((5,), "deg"),
}
#: The same of contacts on an edge.
EDGE_PARTS: Parts = {
    "depth": ((2,), "mm"),
    "offset": ((1,), "mm"),
    "direction": ((5,), "deg"),
    "tilt": ((3, 4), "deg"),
}
#: And of forces, where the network tells them.
FORCE_PART: Parts = {"force": (tuple(range(POSE, POSE + len(FORCES))), "N")}
UNITS = {name: unit for parts in (PARTS, EDGE_PARTS, FORCE_PART) for name, (_, unit) in parts.items()}
HELD_BACK = 5  # one of so many
COVERED = LEVELS.index(0.95)
CONTACTS, JUDGING, ROUNDS = "contacts", "held_back", "rounds"
_JUDGED, _RESAMPLES = "judged.json", 1000


def parts_of(model: ContactModel) -> Parts:
    """What is judged, and may be promised, of networks of a contact model."""
    return {**(EDGE_PARTS if model.directed else PARTS), **(FORCE_PART if model.forces else {})}


class LearningError(ValueError):
    """Why no network came of some contacts."""


@dataclass(frozen=True)
class Promise:
    """Mean absolute errors that are not to be exceeded, by the names of parts, in their units.

    Kept where the upper end of the 95 % band of each stays below: with few contacts held back it is wide.
    """

    errors: Mapping[str, float]

    @classmethod
    def parse(cls, texts: Sequence[str], parts: Parts = PARTS) -> Promise:
        """Of texts as depth=0.3; `SettingError` says what is wrong."""
        errors = {}
        for text in texts:
            name, value = name_and_value(text, "depth=0.3")
            if name not in parts:
                raise SettingError(f"--promise {text}: {unknown_name(name, list(parts))}")
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 < value < math.inf:
                raise SettingError(f"--promise {text}: must be a number above 0, in {UNITS[name]}")
            errors[name] = float(value)
        return cls(errors)

    def kept_by(self, judged: Judged) -> bool:
        """Whether all errors are within it for sure; one that was not judged is none."""
        found = judged.errors
        return all(name in found and found[name][2] <= most for name, most in self.errors.items())

    def __str__(self) -> str:
        return ", ".join(f"{name} {most:g} {UNITS[name]}" for name, most in self.errors.items())


@dataclass(frozen=True)
class Judged:
    """What a round's network is worth on the contacts held back by then.

    Attributes
    ----------
    contacts, held_back : how many there were in all, and how many of them judged
    errors : name of a part -> mean absolute error and the ends of its 95 % bootstrap band, mm, deg or N
    coverage : the part of errors within the model's 95 % interval (0..1); None: it tells no uncertainty
    foreign : the part of the images held back that are foreign to it (0..1); None: it cannot tell
    """

    contacts: int
    held_back: int
    errors: Mapping[str, tuple[float, float, float]]
    coverage: float | None
    foreign: float | None

    def line(self) -> str:
        """In words."""
        found = (
            f"{name} {value:.2g} {UNITS[name]} ({low:.2g} to {high:.2g})"
            for name, (value, low, high) in self.errors.items()
        )
        covered = "" if self.coverage is None else f"; {self.coverage:.0%} within the 95 % interval"
        return f"{self.contacts} contacts: {', '.join(found)}{covered}"


@dataclass(frozen=True)
class Round:
    """The files of a round."""

    folder: Path
    total: int

    @property
    def path(self) -> Path:
        return self.folder / ROUNDS / f"{self.total:05d}"

    @property
    def run(self) -> Path:
        """The folder of its network's run."""
        return self.path / "run"

    @property
    def judged(self) -> Judged | None:
        """What was found; None as long as it was not. `ValueError` for a damaged file."""
        file = self.path / _JUDGED
        if not file.exists():
            return None
        values = parse_json(read_text(file))
        return Judged(**values | {"errors": {name: tuple(each) for name, each in values["errors"].items()}})

    def judge(self) -> Judged:
        """Measure the network on what is held back, and keep it."""
        found = judged(self.run, self.folder / JUDGING, self.total)
        with whole_file(self.path / _JUDGED) as temporary:
            temporary.write_text(json.dumps(dataclasses.asdict(found), indent=2) + "\n")
        return found


class Training:
    """A round's network, trained beside by `tactile train`; `words` are its options."""

    def __init__(self, chosen: Round, words: Sequence[str]) -> None:
        self.round = chosen
        data = snapshot(chosen.folder / CONTACTS, chosen.path / CONTACTS)
        self.log = chosen.path / "training.txt"
        command = [sys.executable, "-m", "tactile_bringup.cli", "train", str(data), "--out", str(chosen.run)]
        trained = (chosen.run / RESULT_NAME).exists()
        self._process = None if trained else self._begun([*command, *words])

    def _begun(self, command: list[str]) -> subprocess.Popen[bytes]:
        with self.log.open("ab") as log:  # in a session of its own: Ctrl-C is the arm's, and `stop` tells it
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True
            )
        give_way(process.pid)
        return process

    @property
    def ended(self) -> bool:
        return self._process is None or self._process.poll() is not None

    def finish(self) -> Judged:
        """Wait for the network and judge it; `LearningError` with its last words where none came of it."""
        if self._process is not None and self._process.wait():
            lines = self.log.read_text(errors="replace").strip().splitlines()
            raise LearningError(
                f"no network of {self.round.total} contacts: {lines[-1] if lines else 'it said nothing'} "
                f"({self.log})"
            )
        return self.round.judged or self.round.judge()

    def stop(self) -> None:
        """End it, where it is not at its end; it goes on from its last epoch another time."""
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            self._process.wait()


#: Brings a data folder to so many contacts, of other poses for what is held back, and returns an exit code;
#: it may end early, with 0, once the last argument says that no more are needed.
Collect = Callable[[Path, int, bool, Callable[[], bool]], int]


class Learning:
    """See the module's text.

    Parameters
    ----------
    totals : contacts in all after each round, growing
    words : options of `tactile train`
    say : gets a line on what goes on
    """

    def __init__(
        self,
        folder: Path,
        totals: Sequence[int],
        promise: Promise,
        collect: Collect,
        words: Sequence[str],
        say: Callable[[str], None] = print,
    ) -> None:
        self.folder, self.promise, self.say = folder, promise, say
        self.rounds = [Round(folder, total) for total in totals]
        self._collect, self._words = collect, words
        self._training: Training | None = None
        self.exit_code = 0  # of the collection, where that did not come to its end

    def run(self) -> list[Judged]:
        """All rounds until the promise is kept; what was found of each. `LearningError` without a network."""
        found: list[Judged] = []
        try:
            for chosen in self.rounds:
                if not self._contacts(chosen) or (self._training is not None and self._finished(found)):
                    return found
                self.say(f"{chosen.total} contacts: a network learns from {_share(chosen.total)[0]} of them")
                self._training = Training(chosen, self._words)
            self._finished(found)
        finally:
            if self._training is not None:
                self._training.stop()
        return found

    def _contacts(self, chosen: Round) -> bool:
        """Have the arm make those of a round; False where it did not come to its end."""
        for name, count in zip((CONTACTS, JUDGING), _share(chosen.total), strict=True):
            self.exit_code = self._collect(self.folder / name, count, name == JUDGING, self._is_enough)
            if self.exit_code:
                return False
        return True

    def _is_enough(self) -> bool:
        """Whether the network trained meanwhile keeps the promise, or there is none, which `run` tells."""
        if self._training is None or not self._training.ended:
            return False
        try:
            return self.promise.kept_by(self._training.finish())
        except LearningError:
            return True

    def _finished(self, found: list[Judged]) -> bool:
        """Judge the network in training; whether it keeps the promise."""
        assert self._training is not None
        found.append(self._training.finish())
        self.say(found[-1].line())
        return self.promise.kept_by(found[-1])


def _share(total: int) -> tuple[int, int]:
    """How many of all contacts are learnt from and held back."""
    return total - total // HELD_BACK, total // HELD_BACK


def snapshot(source: Path, target: Path) -> Path:
    """A data folder as it is now, whole or not at all: images as links, since only tables grow."""

    def take(file: str, copy: str) -> None:
        if file.endswith((".png", ".jpg")):
            try:
                os.link(file, copy)
                return
            except OSError:  # another file system
                pass
        shutil.copy2(file, copy)

    if not target.exists():
        partial = target.with_name(f"{target.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        shutil.copytree(source, partial, copy_function=take)
        partial.rename(target)
    return target


def evaluated(run: Path, folder: Path) -> tuple[EvaluationData, ModelResult, Estimator]:
    """A network's answers to a data folder."""
    models = open_models([run])
    data = load_data(folder, models)
    (result,) = evaluate(data, models)
    return data, result, models[0].estimator


def judged(run: Path, folder: Path, contacts: int) -> Judged:
    """What the network of a run is worth on the contacts of a folder."""
    data, result, estimator = evaluated(run, folder)
    predictions, told = result.best.predictions, data.model
    mean = np.full((len(data), told.size), np.nan)
    mean[:, list(data.compared)] = predictions.mean
    error = np.abs(euler_error(data.euler_mm_deg, told.euler(np.nan_to_num(mean))))
    error = np.hstack([error, np.abs(mean - data.labels)[:, POSE:]])
    picks = np.random.default_rng(0).integers(len(data), size=(_RESAMPLES, len(data)))
    errors = {}
    for name, (columns, _) in parts_of(told).items():
        if set(columns) <= set(data.compared):
            each = error[:, list(columns)].mean(axis=1)
            low, high = np.percentile(each[picks].mean(axis=1), (2.5, 97.5))
            errors[name] = (float(each.mean()), float(low), float(high))
    consistency = result.best.consistency
    covered = None if consistency is None else float(consistency.coverage[COVERED].mean())
    return Judged(contacts, len(data), errors, covered, _foreign(estimator, data))


def _foreign(estimator: Estimator, data: EvaluationData) -> float | None:
    measure = estimator.metadata.novelty
    if measure is None:
        return None
    images = data.images[estimator.metadata.preprocessing]
    return float(np.mean([measure(as_input(image)) > 1.0 for image in images]))


def with_more(found: Sequence[Judged], name: str, contacts: int) -> float:
    """The error to expect of so many contacts, by a power law through what rounds had; NaN of one round."""
    rows = [(judged.contacts, judged.errors[name][0]) for judged in found if name in judged.errors]
    if len(rows) < 2:
        return math.nan
    had, errors = np.log(np.array(rows)).T
    slope, at_one = np.polyfit(had, errors, 1)
    return float(np.exp(at_one + slope * np.log(contacts))) if slope < 0.0 else rows[-1][1]
