"""An error of somebody else's code: whose it is, and the line to look at."""

import sys
from types import ModuleType

import pytest

from tactile_base import raised
from tactile_base.raised import LIBRARY, PLUGIN, raised_at, raised_by, raised_in_plugin, told
from tactile_geometry import se3

SOURCE = """
import numpy as np
from tactile_geometry import se3


class Bowl:
    def inside_numpy(self):
        return np.linalg.inv(np.zeros((2, 2)))

    def inside_ours(self):
        return se3.pose_from_euler("x")

    def itself(self):
        return {}["speed"]
"""


def load(path, name):
    path.write_text(SOURCE)
    module = ModuleType(name)
    module.__file__ = str(path)
    sys.modules[name] = module
    exec(compile(SOURCE, str(path), "exec"), module.__dict__)
    return module.Bowl


@pytest.fixture
def bowl(tmp_path, monkeypatch):
    """A plug-in that was loaded as a shape, in a folder of its own."""
    monkeypatch.setattr(raised, "_PLUGINS", {})
    kind = load(tmp_path / "my_bowl.py", "my_bowl")
    raised.note_plugin(kind, "shape 'bowl'")
    yield kind
    sys.modules.pop("my_bowl", None)


def caught(call):
    """The error of a call, as if our code had caught it: without the frame of this function."""
    with pytest.raises(Exception) as found:
        call()
    error = found.value
    places = error.__traceback__
    while places is not None and places.tb_frame.f_code.co_filename == __file__:
        places = places.tb_next
    return error.with_traceback(places)


def test_an_error_inside_a_library_is_told_with_the_plugins_own_line(bowl):
    error = caught(bowl().inside_numpy)
    assert raised_by(error) == LIBRARY and raised_at(error).endswith("my_bowl.py:8")
    text = told(error)
    assert text.startswith("shape 'bowl': LinAlgError: Singular matrix (") and text.endswith("my_bowl.py:8)")


def test_an_error_in_our_code_that_a_plugin_called_has_both_lines(bowl):
    place = raised_at(caught(bowl().inside_ours))
    assert "my_bowl.py:11, in " in place and "tactile_geometry" in place


def test_an_error_of_a_plugin_itself_has_its_line(bowl):
    error = caught(bowl().itself)
    assert raised_by(error) == PLUGIN
    assert told(error).startswith("shape 'bowl': KeyError: 'speed' (") and raised_at(error).endswith(":14")


def test_a_plugin_that_is_installed_among_libraries_is_no_library(tmp_path, monkeypatch):
    monkeypatch.setattr(raised, "_PLUGINS", {})
    folder = tmp_path / "lib" / "site-packages"
    folder.mkdir(parents=True)
    kind = load(folder / "my_bowl.py", "my_bowl")
    assert raised_in_plugin(caught(kind().itself)) == ""
    raised.note_plugin(kind, "shape 'bowl'")
    assert raised_in_plugin(caught(kind().inside_numpy)).endswith("site-packages/my_bowl.py:8")


def test_an_error_of_ours_has_our_line_and_nobodys_name():
    error = caught(lambda: se3.pose_from_euler("x"))
    assert "tactile_geometry" in raised_at(error) and told(error).startswith("ValueError: ")


def test_what_a_plugin_gave_is_told_where_its_own_code_has_raised_nothing(bowl):
    text = told(caught(lambda: se3.pose_from_euler("x")), bowl)
    assert text.startswith("shape 'bowl': ValueError: ")
    assert "tactile_geometry" in text and text.endswith("my_bowl.py:7 gives)")


def test_a_file_that_is_no_python_is_told_with_its_line(tmp_path):
    error = caught(lambda: compile("def broken(:\n", str(tmp_path / "broken.py"), "exec"))
    assert raised_at(error) == f"{tmp_path / 'broken.py'}:1"
