"""Malformed JSON of published data sets."""

import pytest

from tactile_perception.datasets import lenient_json


def test_well_formed_json_needs_no_repair():
    assert lenient_json.loads('{"a": [1, 2], "b": "}]"}', "x.json") == ({"a": [1, 2], "b": "}]"}, [])


def test_a_doubled_bracket_is_dropped_and_named():
    value, repairs = lenient_json.loads('{"pose": [0, 72, 225]]}', "env_params.json")
    assert value == {"pose": [0, 72, 225]}
    assert repairs == ["env_params.json: malformed JSON; dropped a surplus ']' at line 1, column 22"]


def test_missing_brackets_at_the_end_are_added_and_named():
    value, repairs = lenient_json.loads('{"a": [1, {"b": 2', "x.json")
    assert value == {"a": [1, {"b": 2}]}
    assert "added the missing '}]}' at the end" in repairs[0]


def test_brackets_inside_strings_are_left_alone():
    value, repairs = lenient_json.loads('{"a": "]\\"}", "b": [1]]}', "x.json")
    assert value == {"a": ']"}', "b": [1]}
    assert len(repairs) == 1


def test_infinity_is_read_as_python_writes_it():
    assert lenient_json.loads('{"r": [-Infinity, Infinity]}', "x")[0] == {"r": [float("-inf"), float("inf")]}


def test_what_cannot_be_repaired_is_an_error_with_its_place():
    with pytest.raises(lenient_json.JsonError, match=r"x\.json: malformed JSON at line 2, column 3"):
        lenient_json.loads('{"a": 1,\n  b}', "x.json")


@pytest.mark.parametrize("text", ["[" * 100_000, "[" * 100_000 + "1" + "]" * 100_000, '{"a": ' * 50_000])
def test_nesting_without_an_end_is_an_error(text):
    with pytest.raises(lenient_json.JsonError, match=r"nested too deeply|not repairable"):
        lenient_json.loads(text, "x.json")


def test_a_text_of_brackets_alone_is_given_up_at_once():
    with pytest.raises(lenient_json.JsonError, match="not repairable"):
        lenient_json.loads("]" * 5_000_000, "x.json")


def test_a_number_of_5000_digits_is_no_error_of_the_parser():
    assert lenient_json.loads(f'{{"a": {"9" * 5000}}}', "x.json")[0] == {"a": float("inf")}
