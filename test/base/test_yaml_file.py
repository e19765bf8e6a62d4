"""YAML from outside: whatever stands in it is a value or a sentence, at once."""

import contextlib
import os
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_base.settings import SettingError
from tactile_base.yaml_file import name_and_value, read_yaml, values_of

BOMB = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
    for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)
BAD = {
    "aliases that multiply": (BOMB, "has more than 20000 values, counting those that aliases repeat"),
    "an alias of itself": ("a: &a [*a]", "an alias repeats what it stands in"),
    "deep nesting": ("a: " + "[" * 10_000, "nested more than 50 deep"),
    "nesting just too deep": ("a: " + "[" * 60 + "]" * 60, "nested more than 50 deep"),
    "an object": ("a: !!python/object/apply:os.system [ls]", "could not determine a constructor for the tag"),
    "a tag of somebody": ("a: !gain 3", "could not determine a constructor for the tag '!gain'"),
    "bytes": ("a: !!binary aGFsbG8=", "could not determine a constructor for the tag"),
    "a date": ("a: !!timestamp soon", "could not determine a constructor for the tag"),
    "no number": ("a: !!int many", "'many' cannot be read as int"),
    "an empty number": ("a: !!int ''", "'' cannot be read as int"),
    "no truth value": ("a: !!bool maybe", "'maybe' cannot be read as bool"),
    "5000 digits": ("a: " + "9" * 5000, "cannot be read as int"),
    "5000 hexadecimal digits": ("a: 0x" + "f" * 5000, "cannot be read as int"),
    "5000 sixtieths": ("a: 1" + ":59" * 5000, "cannot be read as int"),
    "a zero byte": ("a: \0", "special characters are not allowed"),
    "two documents": ("a: 1\n---\na: 2", "found another document"),
    "a merge of a number": ("a: {<<: 3}", "expected a mapping"),
    "a megabyte": ("a: " + "x" * 1_000_000, "has 1000003 characters"),
}


@pytest.mark.parametrize(("text", "complaint"), BAD.values(), ids=BAD)
def test_what_is_no_settings_file_is_refused_in_a_sentence(tmp_path, text, complaint):
    file = tmp_path / "bad.yaml"
    file.write_text(text)
    with pytest.raises(SettingError, match=rf"bad\.yaml:.*{re.escape(complaint)}"):
        read_yaml(file)
    with pytest.raises(SettingError, match=re.escape(complaint)):
        values_of(text, "goal")
    with pytest.raises(SettingError, match=re.escape(complaint)):
        name_and_value(f"task.speed={text}", "task.speed=0.01")


@given(st.text() | st.text(alphabet="&*[]{}:,-? \n!<|>'\"0123456789abef.#%@"))
def test_any_text_is_settings_or_is_refused(text):
    with contextlib.suppress(SettingError):
        values_of(text, "goal")


def test_numbers_dates_and_what_aliases_repeat_are_read_as_everybody_takes_them():
    text = "{a: 1e-3, b: &x [-2E5, .5e+1], c: *x, d: 1e5th, e: 2026-11-22, f: .inf, g: 0x10, h: yes, i: null}"
    assert values_of(text, "goal") == {
        "a": 1e-3, "b": [-2e5, 5.0], "c": [-2e5, 5.0], "d": "1e5th", "e": "2026-11-22", "f": float("inf"),
        "g": 16, "h": True, "i": None,
    }  # fmt: skip
    assert name_and_value("a.b=1e-3", "")[1] == 1e-3


def test_what_is_no_regular_file_is_refused_and_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "pipe.yaml")
    for path, kind in ((tmp_path / "pipe.yaml", "a pipe"), ("/dev/zero", "a device"), (tmp_path, "a folder")):
        with pytest.raises(OSError, match=f"{path}: is {kind}, must be a file"):
            read_yaml(path)


def test_a_file_that_is_too_long_is_not_read(tmp_path):
    file = tmp_path / "long.yaml"
    with file.open("wb") as sparse:
        sparse.truncate(10**12)
    with pytest.raises(OSError, match="has 1000000000000 bytes, more than 10000000"):
        read_yaml(file)
