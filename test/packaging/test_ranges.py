"""Every number that can be set has a range of the thing that it is of, not of floating point."""

import dataclasses
import math

import pytest
from all_settings import all_settings

from tactile_base.settings import SettingError, bounds_of

#: Settings without a finite largest value, and why.
UNLIMITED = {
    "PidSettings.integral_limit": "infinity switches the limit off",
    "PidSettings.output_limit": "infinity switches the limit off",
}

NUMBERS = [
    pytest.param(kind, field, id=f"{kind.__name__}.{field.name}")
    for kind in all_settings()
    for field in dataclasses.fields(kind)
    if (isinstance(field.default, int | float) and not isinstance(field.default, bool))
    or (isinstance(field.default, tuple) and "str" not in str(field.type))
]


def test_the_walk_finds_the_settings_of_all_packages():
    packages = {kind.__module__.split(".")[0] for kind in all_settings()}
    assert packages >= {
        f"tactile_{name}" for name in ("filter", "perception", "control", "scene", "drivers", "ros")
    }
    assert len(NUMBERS) > 280


@pytest.mark.parametrize(("kind", "field"), NUMBERS)
def test_a_number_has_finite_bounds_or_a_reason_for_having_none(kind, field):
    if field.metadata["choices"] is not None:
        return
    assert field.metadata["doc"]
    for index in range(field.metadata["length"] or 1):
        lower, upper = bounds_of(field.metadata, index)
        assert lower is not None and math.isfinite(lower)
        if f"{kind.__name__}.{field.name}" in UNLIMITED:
            assert upper == math.inf and ".inf" in field.metadata["doc"]
        else:
            assert upper is not None and lower < upper < 1e13


@pytest.mark.parametrize(("kind", "field"), NUMBERS)
def test_what_is_no_number_of_a_thing_is_refused_by_name(kind, field):
    several = isinstance(field.default, tuple)
    values = [math.nan, -math.inf, -1e308, -(10**19)]
    if f"{kind.__name__}.{field.name}" not in UNLIMITED:
        values += [math.inf, 1e308, 10**19]
    for value in values:
        given = [*field.default[1:], value] if several else value
        with pytest.raises(SettingError, match=rf"^{field.name}\b"):
            kind(**{field.name: given})
