"""Entries by name: this package's, and other packages' through entry points."""

import sys
from pathlib import Path

import pytest

from tactile_base.registry import Registry
from tactile_base.settings import SettingError

GROUP = "tactile_servoing.test_things"


@pytest.fixture
def other_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that is installed beside ours and brings an entry."""
    (tmp_path / "other_things.py").write_text("class Thing:\n    pass\n")
    (tmp_path / "other_slip.py").write_text("SPEED = 1.0\nLIMIT = float('fast')\n")
    info = tmp_path / "other_things-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other-things\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[{GROUP}]\nthing = other_things:Thing\nbroken = other_things:Missing\n"
        "settings = other_things:Thing\nslip = other_slip:Thing\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "other_things", raising=False)


@pytest.fixture
def registry() -> Registry[type]:
    return Registry("thing", GROUP, {"settings": "tactile_base.settings:Settings"})


def test_an_entry_of_this_package_is_loaded_by_its_name(registry: Registry[type]):
    from tactile_base.settings import Settings

    assert registry.load("settings") is Settings


def test_another_package_adds_entries_without_a_change_here(registry: Registry[type], other_package: None):
    assert registry.load("thing").__name__ == "Thing"
    assert registry.names() == ("settings", "broken", "slip", "thing")


def test_a_package_that_is_installed_while_we_run_is_found(registry, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    assert registry.names() == ("settings",)
    info = tmp_path / "late-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: late\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nlate = late:Thing\n")
    assert registry.names() == ("settings", "late")


def test_another_package_cannot_replace_an_entry_of_this_one(registry: Registry[type], other_package: None):
    assert registry.load("settings").__module__ == "tactile_base.settings"


def test_an_unknown_name_is_refused_with_the_names_there_are(registry: Registry[type]):
    with pytest.raises(SettingError, match=r"'setings'.*settings"):
        registry.load("setings")


def test_an_entry_that_cannot_be_imported_says_where_it_should_be(
    registry: Registry[type], other_package: None
):
    with pytest.raises(SettingError, match=r"thing 'broken': other_things:Missing cannot be loaded"):
        registry.load("broken")


def test_an_error_in_somebody_elses_module_has_its_file_and_line(
    registry: Registry[type], other_package: None
):
    with pytest.raises(SettingError, match=r"ValueError: could not convert .*'fast' \(.*other_slip.py:2\)"):
        registry.load("slip")


def test_entries_say_whose_they_are_and_what_shadows_them(registry: Registry[type], other_package: None):
    found = {(entry.package, entry.name): entry.shadowed_by for entry in registry.entries()}
    assert found == {
        ("tactile_servoing", "settings"): "",
        ("other-things", "settings"): "tactile_servoing",
        ("other-things", "thing"): "",
        ("other-things", "broken"): "",
        ("other-things", "slip"): "",
    }
