"""Values set in a YAML file leave all else in it as it was written."""

import pytest
import yaml

from tactile_base.yaml_edit import YamlEditError, with_values

TEXT = """\
# a cell
arms:
  left:   # the first
    start: {position: [0, 0, 1]}
    sensor:
      in_tool: {position: [0, 0, 0.06]}   # measured
      camera: external
      camera_settings:
        transport: compressed   # over the network

      # of the model
      model: mine.onnx
  right: {start: {position: [0, 0, 2]}, sensor: {camera: sim, camera_rate: 60}}
  bare:
    start: {position: [0, 0, 3]}
bodies: {}
"""
NEW = {"camera": "uvc", "camera_settings": {"device": "/dev/video0", "width": 640}, "camera_rate": 30.0}


@pytest.mark.parametrize("arm", ["left", "right", "bare"])
def test_values_are_set_and_all_others_stay(arm):
    expected = yaml.safe_load(TEXT)
    expected["arms"][arm].setdefault("sensor", {}).update(NEW)
    assert yaml.safe_load(with_values(TEXT, ["arms", arm, "sensor"], NEW)) == expected


def test_comments_and_order_of_what_is_not_set_stay():
    found = with_values(TEXT, ["arms", "left", "sensor"], NEW).splitlines()
    gone = {
        "      camera: external",
        "      camera_settings:",
        "        transport: compressed   # over the network",
    }
    kept = [line for line in TEXT.splitlines() if line not in gone]
    assert [line for line in found if line in kept] == kept
    assert len(found) == len(kept) + 3


@pytest.mark.parametrize(
    "others",
    [
        "      gain:    1.0   # aligned\n      reach:   1e-3  # too\n",
        "      in_tool: { position: [ 0, 0, 0.06 ] }\n",
        "      matrix: [\n        1, 0,  # x\n        0, 1]  # y\n",
        "      mask: null\n      tip: ~\n",
        "      tags:\n        - 'a'\n        - \"b\"\n",
    ],
)
def test_what_is_not_set_stays_letter_by_letter(others):
    text = f"arms:\n  left:\n    sensor:\n      camera: external\n{others}"
    assert with_values(text, ["arms", "left", "sensor"], {"camera": "uvc"}) == text.replace("external", "uvc")


def test_setting_the_same_values_again_changes_nothing():
    once = with_values(TEXT, ["arms", "left", "sensor"], NEW)
    assert with_values(once, ["arms", "left", "sensor"], NEW) == once


@pytest.mark.parametrize(
    "text, keys, complaint",
    [
        (TEXT, ["arms", "middle", "sensor"], "arms.middle: must hold names and values"),
        (TEXT, ["arms", "left", "start", "position"], "arms.left.start.position: must hold names"),
        ("arms: [", ["arms"], "not valid YAML"),
        ("", ["arms"], "the file: must hold names and values"),
    ],
)
def test_a_place_that_is_not_there_is_refused_by_name(text, keys, complaint):
    with pytest.raises(YamlEditError, match=complaint):
        with_values(text, keys, NEW)
