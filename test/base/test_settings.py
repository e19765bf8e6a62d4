"""Settings refuse what is wrong with a message that says what would be right."""

from dataclasses import FrozenInstanceError, dataclass

import numpy as np
import pytest

from tactile_base.settings import SettingError, Settings, setting


@dataclass(frozen=True)
class ExampleSettings(Settings):
    probability: float = setting(0.9, lower=0.0, upper=1.0, doc="a probability")
    gains: tuple[float, ...] = setting([1.0, 2.0], length=2, lower=0.0, doc="two gains")
    mode: str = setting("paper", choices=("paper", "fast"), doc="a choice")
    count: int = setting(3, lower=1, doc="a count")
    enabled: bool = setting(True, doc="a switch")
    pose: tuple[float, ...] = setting(
        [0.0] * 4, length=4, lower=[-0.01, 0.0, -3.0, -3.0], upper=[0.01, 0.01, 3.0, 3.0],
        unit="m, rad", doc="two lengths and two angles",
    )  # fmt: skip
    limits: tuple[float, ...] = setting([1.0], lower=0.0, upper=float("inf"), doc="inf: no limit")
    target: tuple[float, ...] = setting((), lower=-10.0, upper=10.0, doc="a place, or none")
    names: tuple[str, ...] = setting((), doc="names, or none")


def test_integers_and_arrays_become_the_declared_types():
    settings = ExampleSettings(probability=1, gains=np.array([1, 2]))
    assert settings.probability == 1.0 and isinstance(settings.probability, float)
    assert settings.gains == (1.0, 2.0)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"probability": 1.5}, r"probability = 1.5: must lie in \[0, 1\]"),
        ({"probability": "high"}, "must be of type float, is str"),
        ({"probability": float("nan")}, "is not a number"),
        ({"gains": [1.0]}, "must have 2 elements, has 1"),
        ({"gains": 1.0}, "must be a list"),
        ({"gains": [1.0, -1.0]}, r"gains\[1\] = -1.0: must lie in \[0, inf\)"),
        ({"gains": [1.0, float("inf")]}, r"gains\[1\] = inf: must lie in \[0, inf\)"),
        ({"pose": [0, 3, 0, 0]}, r"pose\[1\] = 3.0 m: must lie in \[0, 0.01\] m"),
        ({"pose": [0, 0, 0, -4]}, r"pose\[3\] = -4.0 rad: must lie in \[-3, 3\] rad"),
        ({"pose": [0, 0, float("nan"), 0]}, r"pose\[2\]: is not a number"),
        ({"limits": [-1.0]}, r"limits\[0\] = -1.0: must lie in \[0, inf\]"),
        ({"target": [1.0, "a"]}, r"target\[1\] = 'a': must be of type float, is str"),
        ({"target": [float("nan")]}, r"target\[0\]: is not a number"),
        ({"target": [11.0]}, r"target\[0\] = 11.0: must lie in \[-10, 10\]"),
        ({"target": {"x": 1.0}}, "target = {'x': 1.0}: must be a list"),
        ({"names": [1.0]}, r"names\[0\] = 1.0: must be of type str, is float"),
        ({"mode": "slow"}, "must be one of paper, fast"),
        ({"count": 1.5}, "must be of type int, is float"),
        ({"count": True}, "must be of type int, is bool"),
        ({"enabled": 1}, "must be of type bool, is int"),
    ],
)
def test_a_bad_value_is_refused_with_name_value_and_range(values, message):
    with pytest.raises(SettingError, match=message):
        ExampleSettings(**values)


def test_infinity_is_taken_only_where_the_declaration_says_so():
    assert ExampleSettings(limits=[float("inf")]).limits == (float("inf"),)


def test_an_unknown_name_lists_the_valid_ones_and_the_nearest():
    with pytest.raises(
        SettingError, match=r"params.yaml:7: unknown name 'gain' \(did you mean 'gains'\?\); valid: .*mode"
    ):
        ExampleSettings.from_mapping({"gain": [1.0, 2.0]}, where="params.yaml:7")


def test_a_refused_replacement_leaves_the_old_settings_as_they_were():
    settings = ExampleSettings()
    with pytest.raises(SettingError):
        settings.replaced(probability=2.0)
    assert settings.probability == 0.9
    assert settings.replaced(probability=0.5).probability == 0.5


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(FrozenInstanceError):
        ExampleSettings().count = 4
