"""The named profiles of the filter are settings that exist and do what their names say."""

import pytest

from tactile_base.config_paths import config_path, named_file
from tactile_filter.files import load_filter_settings
from tactile_filter.fusion import MODES


@pytest.mark.parametrize("name", MODES)
def test_each_mode_of_the_fusion_has_a_profile_of_its_name(name):
    settings = load_filter_settings(named_file("filter", name))
    assert settings.fusion_mode == name
    assert settings.jacobian_order == "mode"


def test_the_profile_named_after_the_paper_has_no_gate():
    assert load_filter_settings(config_path("filters/paper.yaml")).gate_probability == 1.0
