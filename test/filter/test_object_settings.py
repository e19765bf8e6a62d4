"""A file about an object gives settings and places, and says what is wrong in it."""

import math

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_filter.object.settings import TrackerSettings, load_object
from tactile_geometry import se3

ARMS = ["left", "right"]


@pytest.fixture
def load(tmp_path):
    def load(text: str):
        file = tmp_path / "box.yaml"
        file.write_text(text)
        return load_object(file, ARMS)

    return load


def test_places_and_settings_are_read_and_what_is_missing_is_found_by_touch(load):
    settings, places = load(
        "settings: {max_age: 0.1}\n"
        "places:\n"
        "  left: {position: [0, 0.03, 0], rotation_deg: [90, 0, 0], sigma_position: [2e-3, 2e-3, 0]}\n"
    )
    assert settings == TrackerSettings(max_age=0.1) and set(places) == {"left"}
    place = places["left"].place()
    np.testing.assert_allclose(place.mean, se3.pose_from_euler(np.array([0, 0.03, 0, math.pi / 2, 0, 0])))


def test_sigmas_are_along_the_features_own_axes(load):
    """The contact may be anywhere in the feature's plane; its axis z is the object's -y here."""
    _, places = load(
        "places: {left: {position: [0, 0.03, 0], rotation_deg: [90, 0, 0], sigma_position: [1e-3, 2e-3, 0]}}"
    )
    cov = places["left"].place().cov
    np.testing.assert_allclose(np.diag(cov)[:3], [1e-6, 0.0, 4e-6], atol=1e-20)
    np.testing.assert_allclose(cov[3:, 3:], 0.0, atol=1e-20)


def test_an_empty_file_has_defaults(load):
    assert load("settings:\nplaces:\n") == (TrackerSettings(), {})


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("places: {lefft: {}}", "1: places: unknown name 'lefft' .did you mean 'left'.*left, right"),
        ("places:\n  left: {positon: [0, 0, 0]}", "2: places.left: unknown name 'positon'"),
        ("places:\n  left: {position: [0, 0]}", "2: places.left.position = .*3 finite numbers"),
        ("places:\n  left: {sigma_position: [0, 0, -1]}", r"places.left: sigma\[2\] = -1.0 m: must lie in"),
        ("settings: {max_age: -1}", "1: settings: max_age = -1.0 s: must lie in"),
        ("settings: {max_age: 1.0}", "max_age = 1 s: must not be longer than forget_after = 0.5 s"),
        ("objects: {}", "unknown name 'objects'"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_line(load, text, complaint):
    with pytest.raises(SettingError, match=rf"box\.yaml:{'' if complaint[0].isdigit() else '.*'}{complaint}"):
        load(text)
