"""`tactile sensor learn`: rounds of contacts and networks until a promise is kept, and interruptions."""

import numpy as np
import pytest
import yaml

pytest.importorskip("torch", reason="training needs PyTorch (the extra 'train')")

from folders import dot_image

from tactile_base.settings import SettingError
from tactile_bringup import learning_page
from tactile_bringup.cli import main
from tactile_bringup.learning import (
    EDGE_PARTS,
    FORCE_PART,
    Judged,
    Learning,
    LearningError,
    Promise,
    snapshot,
    with_more,
)
from tactile_perception.datasets.dataset import DatasetWriter, open_folder
from tactile_perception.datasets.layout import FORCE_COLUMNS
from tactile_perception.estimating.estimator import Estimator
from tactile_perception.estimating.preprocessing import PreprocessingSettings

QUICK = {
    "network": {"image_size": 32, "channels": [8, 16, 16], "head_gain": 1.0},
    "training": {"batch_size": 8, "rise_epochs": 0, "hold_epochs": 2, "decay_epochs": 2, "threads": 1,
                 "holdback": 0.5},
    "calibration": {"min_samples": 20},
}  # fmt: skip
TOTALS = (50, 80)
EASY, HARD = Promise({"depth": 100.0}), Promise({"depth": 1e-3})


def collect(folder, count, validation, enough):
    """In place of an arm: images whose blob tells x, y and z."""
    with DatasetWriter(folder, PreprocessingSettings()) as writer:
        for number in sorted(set(range(1, count + 1)) - writer.done):
            rng = np.random.default_rng([validation, number])
            euler = rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1])
            writer.add(number, dot_image(euler, rng), euler)
        writer.finish()
    return 0


@pytest.fixture(scope="module")
def words(tmp_path_factory):
    path = tmp_path_factory.mktemp("config") / "quick.yaml"
    path.write_text(yaml.safe_dump(QUICK))
    return ["--config", str(path)]


@pytest.fixture(scope="module")
def learned(words, tmp_path_factory):
    """Two rounds whose networks cannot keep what was promised."""
    folder = tmp_path_factory.mktemp("learned")
    return folder, Learning(folder, TOTALS, HARD, collect, words).run()


def test_each_round_has_a_network_judged_on_contacts_that_it_never_saw(learned):
    folder, found = learned
    assert [(each.contacts, each.held_back) for each in found] == [(50, 16), (80, 16)]
    assert len(open_folder(folder / "contacts")) == 64
    for total, count in ((50, 40), (80, 64)):
        seen = folder / "rounds" / f"{total:05d}" / "contacts"
        assert len(open_folder(seen)) == count, "as the contacts were then"
    value, low, high = found[-1].errors["depth"]
    assert 0.0 < low < value < high and set(found[-1].errors) == {"depth", "tilt", "shear", "twist"}
    assert 0.0 <= found[-1].coverage <= 1.0 and found[-1].foreign is not None


def test_what_is_done_is_not_done_again_and_more_contacts_go_on(learned, words):
    folder, found = learned
    said = []

    def none_missing(path, count, validation, enough):
        before = len(open_folder(path))
        collect(path, count, validation, enough)
        assert len(open_folder(path)) == before
        return 0

    assert Learning(folder, TOTALS, HARD, none_missing, ["--no-such-option"], said.append).run() == found


def test_a_promise_that_is_kept_ends_it(words, tmp_path):
    asked = []

    def counted(folder, count, validation, enough):
        asked.append(count)
        return collect(folder, count, validation, enough)

    learning = Learning(tmp_path, TOTALS, EASY, counted, words)
    (found,) = learning.run()
    assert found.contacts == 50 and EASY.kept_by(found) and not HARD.kept_by(found)
    assert learning.exit_code == 0


def test_an_arm_that_was_stopped_ends_it_and_the_network_goes_on_another_time(words, tmp_path):
    def stopped(folder, count, validation, enough):
        return 130 if count > 40 else collect(folder, count, validation, enough)

    first = Learning(tmp_path, TOTALS, HARD, stopped, words)
    assert first.run() == [] and first.exit_code == 130
    assert not (tmp_path / "rounds/00050/run/result.json").exists(), "its training was stopped"
    found = Learning(tmp_path, TOTALS[:1], HARD, collect, words).run()
    assert [each.contacts for each in found] == [50]


def test_a_training_that_fails_says_why(tmp_path):
    with pytest.raises(LearningError, match=r"no network of 50 contacts: .*no-such-option"):
        Learning(tmp_path, TOTALS, HARD, collect, ["--no-such-option"]).run()


def test_a_snapshot_is_whole_and_stays_as_it_was(tmp_path):
    source = tmp_path / "a"
    collect(source, 3, False, None)
    copy = snapshot(source, tmp_path / "b" / "contacts")
    collect(source, 5, False, None)
    assert len(open_folder(copy)) == 3 and snapshot(source, copy) == copy
    assert len(open_folder(copy)) == 3


def test_the_page_shows_rounds_promise_and_examples(learned):
    folder, found = learned
    run = folder / "rounds" / "00080" / "run"
    page, *pictures = learning_page.write(folder, found, found[-1], run, Promise({"depth": 0.2, "tilt": 2.0}))
    text = page.read_text()
    assert "promise of depth 0.2 mm, tilt 2 deg is not kept" in text and "160 contacts would give" in text
    assert all(path.stat().st_size > 10_000 for path in pictures) and text.count("data:image/png") == 3


def test_networks_of_folds_are_one_that_is_judged_and_go_on_after_an_interruption(words, tmp_path):
    def stopped(folder, count, validation, enough):
        return 130 if count > 40 else collect(folder, count, validation, enough)

    folds = [*words, "--folds", "2"]
    assert Learning(tmp_path, TOTALS, HARD, stopped, folds).run() == []
    (found,) = Learning(tmp_path, TOTALS[:1], HARD, collect, folds).run()
    run = tmp_path / "rounds" / "00050" / "run"
    assert Estimator(run / "model.onnx").metadata.calibration.samples == 40
    page, *_ = learning_page.write(tmp_path, [found], found, run, HARD)
    assert "promise of depth 0.001 mm is not kept" in page.read_text()


def test_on_an_edge_offset_and_direction_are_judged(words, tmp_path):
    on_edge = [*words, "--set", "training.model=edge"]
    (found,) = Learning(tmp_path, TOTALS[:1], HARD, collect, on_edge).run()
    assert set(found.errors) == {"depth", "offset", "direction", "tilt"}
    run, promise = tmp_path / "rounds" / "00050" / "run", Promise.parse(["offset=0.1"], EDGE_PARTS)
    page, *_ = learning_page.write(tmp_path, [found], found, run, promise)
    assert "promise of offset 0.1 mm is not kept" in page.read_text()


def test_where_forces_are_measured_their_error_is_judged_and_promised(words, tmp_path):
    def pressed(folder, count, validation, enough):
        with DatasetWriter(folder, PreprocessingSettings(), extra=FORCE_COLUMNS) as writer:
            for number in sorted(set(range(1, count + 1)) - writer.done):
                rng = np.random.default_rng([validation, number])
                euler = rng.uniform([-4, -4, 0.5, -1, -1, -1], [4, 4, 6, 1, 1, 1])
                forces = {"Fx": -0.1 * euler[0], "Fy": -0.1 * euler[1], "Fz": -0.5 * euler[2]}
                writer.add(number, dot_image(euler, rng), euler, forces)
            writer.finish()
        return 0

    with_force = [*words, "--set", "training.model=surface_force"]
    (found,) = Learning(tmp_path, TOTALS[:1], HARD, pressed, with_force).run()
    value, low, high = found.errors["force"]
    assert 0.0 < low < value < high < 2.0, "in N"
    run, promise = tmp_path / "rounds" / "00050" / "run", Promise.parse(["force=0.001"], FORCE_PART)
    page, *_ = learning_page.write(tmp_path, [found], found, run, promise)
    assert "promise of force 0.001 N is not kept" in page.read_text()


def test_more_contacts_are_told_by_a_power_law():
    found = [Judged(n, 10, {"depth": (8.0 / n**0.5, 0, 0)}, 0.95, 0.0) for n in (100, 400)]
    assert with_more(found, "depth", 1600) == pytest.approx(0.2)
    assert np.isnan(with_more(found[:1], "depth", 1600))
    worse = [Judged(n, 10, {"depth": (n, 0, 0)}, 0.95, 0.0) for n in (100, 400)]
    assert with_more(worse, "depth", 800) == 400


def test_a_promise_is_kept_by_the_upper_end_of_the_band_and_by_what_is_judged():
    judged = Judged(100, 20, {"depth": (0.2, 0.15, 0.26)}, 0.95, 0.0)
    assert Promise({"depth": 0.26}).kept_by(judged) and not Promise({"depth": 0.25}).kept_by(judged)
    assert not Promise({"depth": 0.3, "tilt": 9.0}).kept_by(judged)
    for text, why in (("deep=1", "deep"), ("depth=-1", "above 0, in mm"), ("tilt=yes", "above 0, in deg")):
        with pytest.raises(SettingError, match=why):
            Promise.parse([text])


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["--contacts", "100", "100"], "must grow"),
        (["--contacts", "124"], "from at least 125 on"),
        (["--set", "nothing.size=3"], "--set nothing.size=3: "),
        (["--set", "training.holdback=0.0"], "there is no other data to choose on"),
        (["--promise", "depth"], "depth"),
        (["--promise", "offset=0.5"], "offset"),
        (["--edge", "--promise", "shear=0.5"], "shear"),
        (["--edge"], "one box with an edge (shape: box); there are: table (plane)"),
        (["--scene", "nowhere"], "nowhere"),
        (["--set", "training.model=surface_force"], "no force sensor measures any"),
        (["--promise", "force=0.5"], "force"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_moves(words, why, tmp_path, capsys):
    assert main(["sensor", "learn", str(tmp_path / "out"), *words]) in (1, 2)
    assert why in " ".join(capsys.readouterr().err.split())
    assert not list(tmp_path.rglob("*.png"))
