"""The double of a scene's arm by hand: it stands where the scene says, and takes what goes wrong as text."""

import json
import subprocess
import sys

import numpy as np
import pytest
from real_arm import address

from tactile_base.config_paths import config_path
from tactile_scene.scene_file import load_scene


def by_hand(text, *words):
    command = [sys.executable, "-m", "tactile_doubles", *map(str, words)]
    return subprocess.run(command, input=text, capture_output=True, text=True, timeout=300)


@pytest.fixture
def scene(tmp_path):
    file = tmp_path / "my_ur_cell.yaml"
    text = config_path("scenes/ur_example.yaml").read_text()
    file.write_text(text.replace("192.168.0.2", address()))
    return file


def test_it_stands_where_the_arm_of_the_scene_starts_and_takes_what_goes_wrong(scene):
    done = by_hand("now\nprotective_stop\nnow\nfly\n", scene)
    assert done.returncode == 0, done.stderr
    told, before, _, after, unknown = done.stdout.splitlines()
    assert "the double of 'arm' listens at 127." in told
    (_, pose, _, stopped), (_, _, _, stopped_then) = (json.loads(line.lower()) for line in (before, after))
    arm = load_scene(scene).arms["arm"]
    tool = arm.T_base_start @ np.linalg.inv(arm.T_tool_controlled)
    np.testing.assert_allclose(pose[:3], tool[:3, 3], atol=1e-6)
    assert not stopped and stopped_then
    assert "'fly' means nothing here; there are protective_stop" in unknown


@pytest.mark.parametrize(
    "words, complaint",
    [
        (["plane"], "0 arms have a double"),
        (["ur_example", "--arm", "left"], "arms with a double: unknown name 'left'; valid: arm"),
        (["ur_example"], "cannot have 192.168.0.2"),
    ],
)
def test_what_cannot_be_is_told_in_a_sentence(words, complaint):
    done = by_hand("", *words)
    assert done.returncode == 2 and complaint in done.stderr and "Traceback" not in done.stderr
