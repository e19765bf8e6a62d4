"""The named profiles of the filter are settings that exist and do what their names say."""

import pytest

from tactile_base.config_paths import config_names, config_path
from tactile_base.settings import SettingError
from tactile_filter.filter_settings import FilterSettings, load_filter_settings
from tactile_filter.fusion import MODES


@pytest.mark.parametrize("name", MODES)
def test_each_mode_of_the_fusion_has_a_profile_of_its_name(name):
    settings = load_filter_settings(name)
    assert settings.fusion_mode == name
    assert settings.jacobian_order == "mode"


def test_the_profile_named_after_the_paper_has_no_gate():
    assert load_filter_settings("paper").gate_probability == 1.0


def test_a_profile_is_found_by_name_and_by_path_and_the_default_without_either(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("reinitialize_after: 7\n")
    assert load_filter_settings(own) == load_filter_settings(str(own)) == FilterSettings(reinitialize_after=7)
    assert load_filter_settings("fast") == load_filter_settings(config_path("filters/fast.yaml"))
    assert load_filter_settings() == load_filter_settings(config_path("filter.yaml"))


def test_an_unknown_profile_is_refused_with_the_names_there_are():
    with pytest.raises(FileNotFoundError) as error:
        load_filter_settings("quick")
    assert all(name in str(error.value) for name in config_names("filters"))


def test_a_profile_with_an_unknown_setting_is_refused_with_file_and_line(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text("iterations: 3\ngate: 1\n")
    with pytest.raises(SettingError, match=r"own\.yaml.*2.*gate"):
        load_filter_settings(own)
