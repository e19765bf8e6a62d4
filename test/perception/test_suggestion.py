"""What a handful of images says of their pre-processing; and that a folder of camera images takes it."""

import json

import cv2
import numpy as np
import pytest
from test_any_image import COLOR, write

from tactile_bringup.cli import main
from tactile_perception.datasets.check_plots import draw_inputs
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.suggestion import suggested
from tactile_perception.estimating.image import ImageError
from tactile_sim.collection import CollectionSettings, collect, load_sensor
from tactile_sim.tactip import TacTip


def contacts(sensor: TacTip, count: int = 6) -> list[np.ndarray]:
    return [collect(sensor, CollectionSettings(), 1, index).image for index in range(count)]


@pytest.fixture(scope="module")
def pins() -> list[np.ndarray]:
    return contacts(TacTip(seed=1))


@pytest.fixture(scope="module")
def gel() -> list[np.ndarray]:
    return contacts(TacTip(load_sensor("gel_dome").sensor, seed=1))


def test_markers_get_a_threshold_and_a_round_view_that_holds_all_of_them(pins):
    found = suggested(pins)
    settings = found.settings
    assert settings.binary and not settings.color and settings.median == 5
    assert 41 <= settings.threshold_block <= 71  # 61 px were chosen by hand for pins 22 px apart
    x0, y0, x1, y1 = settings.bbox
    sensor = TacTip(seed=1)
    for number in range(3):
        collect(sensor, CollectionSettings(), 1, number)
        middle, radius = np.array([x0 + x1, y0 + y1]) / 2.0, settings.circle_mask_radius
        assert np.linalg.norm(sensor.marker_pixels - middle, axis=1).max() < radius
    assert any("331 markers" in reason for reason in found.reasons)


def test_three_channels_that_are_alike_are_gray(pins):
    noise = np.random.default_rng(0).integers(0, 3, (480, 640, 3), dtype=np.uint8)
    found = suggested(
        [np.clip(image[:, :, None] + noise.astype(int), 0, 255).astype(np.uint8) for image in pins]
    )
    assert not found.settings.color and found.settings.binary


def test_gel_in_colored_light_keeps_its_colors_and_is_compared_where_that_is_possible(gel):
    alone, with_reference = suggested(gel), suggested(gel, reference=True)
    for settings in (alone.settings, with_reference.settings):
        assert settings.color and not settings.binary and settings.raw_shape == (240, 320)
        x0, _, x1, _ = settings.bbox
        assert x0 < 45 and x1 > 275  # the dome is 230 px wide
    assert alone.settings.difference == 0.0 and with_reference.settings.difference > 1.0


def test_a_lamps_glare_forbids_a_threshold(pins):
    dim = [(image // 3).astype(np.uint8) for image in pins]
    assert suggested(dim).settings.binary
    for image in dim:
        cv2.circle(image, (300, 220), 6, 250, -1)
    found = suggested(dim)
    assert not found.settings.binary and any("glare" in reason for reason in found.reasons)


def test_too_few_images_or_several_sizes_are_refused(pins):
    for images in (pins[:2], [*pins[:3], pins[0][:100]]):
        with pytest.raises(ImageError, match="needs three or more of one size"):
            suggested(images)


def test_the_picture_shows_images_above_what_a_network_sees(gel, tmp_path):
    settings = suggested(gel, reference=True).settings
    draw_inputs(gel, settings, tmp_path / "inputs.png", TacTip(load_sensor("gel_dome").sensor).image())
    picture = cv2.imread(str(tmp_path / "inputs.png"))
    above, below = picture[: len(picture) // 2], picture[len(picture) // 2 :]
    dark = [(part.max(axis=2) < 20).mean() for part in (above, below)]
    assert dark[0] > 0.1 > dark[1]  # a difference is mid-gray where nothing has changed


# ---- folders ----


def unstated(path, **stated):
    """A folder of camera images in color, of which only this is stated."""
    folder = write(path, COLOR, 6, images="raw")
    (folder / "processed_image_params.json").unlink()
    if stated:
        (folder / "sensor_image_params.json").write_text(json.dumps(stated))
    return folder


def test_a_folder_of_camera_images_is_read_as_suits_them_and_says_so(tmp_path):
    source = open_folder(unstated(tmp_path / "data"))
    settings = source.preprocessing
    assert settings.color and not settings.binary and settings.difference > 1.0
    assert source.image(0).shape == (48, 64, 3)
    assert any(settings.steps in note for note in source.report.notes)


def test_what_a_folder_states_is_not_guessed(tmp_path):
    stated = {"gray": True, "bbox": [2, 2, 60, 40], "dims": [64, 48], "thresh": [11, 3]}
    settings = open_folder(unstated(tmp_path / "data", **stated)).preprocessing
    assert settings.bbox == (2, 2, 60, 40) and settings.binary and settings.threshold_block == 11
    assert not settings.color and settings.raw_shape == (48, 64)


def test_the_check_draws_what_a_network_sees(tmp_path, capsys):
    folder = unstated(tmp_path / "data")
    main(["data", "check", str(folder), "--out", str(tmp_path / "check")])
    assert (tmp_path / "check" / "inputs.png").exists()
    assert "A network sees" in " ".join(capsys.readouterr().out.split())


def test_a_camera_proposes_its_preprocessing(tmp_path, monkeypatch, capsys, gel):
    for number, image in enumerate(gel):
        cv2.imwrite(str(tmp_path / f"image_{number}.png"), image)
    source = ["--driver", "replay", "--set", f"path={tmp_path}", "--set", "color=true", "--rate", "20"]
    out = tmp_path / "out" / "inputs.png"
    out.parent.mkdir()
    assert main(["camera", "inputs", *source, "--seconds", "1", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "in color" in said and "a network sees: " in said
    assert out.exists() and "color: true" in out.with_suffix(".yaml").read_text()
