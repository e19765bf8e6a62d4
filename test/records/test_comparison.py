"""Runs compared: grouped by their settings, and nothing is called a difference that chance makes."""

import json

import numpy as np
import pytest
from scipy import stats

from tactile_records.runs.comparison import (
    LARGER,
    UNTOLD,
    WITHIN,
    differences,
    groups_of,
    read_compared,
)
from tactile_records.runs.comparison_page import compared, write_comparison


def report(folder, seed, speed=0.01, **numbers):
    """A folder with the report of a run."""
    values = {
        "scene": "plane", "task": "surface_following", "task_file": "surface_following", "role": "follower",
        "arm": "arm", "source": "ros", "seed": seed, "settings": {"controller": {"task.speed": speed}},
        **numbers,
    }  # fmt: skip
    folder.mkdir(parents=True)
    (folder / "report.json").write_text(json.dumps(values))
    return folder


def compare(folders):
    return differences(groups_of(read_compared(folders)))


def test_a_difference_is_found_where_there_is_one_and_only_there(tmp_path):
    rng = np.random.default_rng(0)
    folders = [
        report(
            tmp_path / f"{k}", k, 0.01 if k < 5 else 0.02, apart=(k >= 5) + rng.normal(0, 0.05), alike=value
        )
        for k, value in enumerate(rng.normal(0, 1, 10))
    ]
    by_number = {found.number: found for found in compare(folders)}
    apart, alike = by_number["apart"], by_number["alike"]
    assert apart.verdict == LARGER and alike.verdict == WITHIN
    assert apart.size == pytest.approx(apart.second.mean() - apart.first.mean())
    assert stats.ttest_ind(apart.first, apart.second, equal_var=False).pvalue < 0.025


def test_chance_alone_is_rarely_called_a_difference(tmp_path):
    """Of 100 comparisons of runs of one kind, with 20 numbers each, about 5 may have a false one."""
    rng, wrong = np.random.default_rng(1), 0
    for trial in range(100):
        folders = [
            report(
                tmp_path / f"{trial}-{k}", k, 0.01 + 0.01 * (k % 2), n=dict(enumerate(rng.normal(0, 1, 20)))
            )
            for k in range(8)
        ]
        wrong += any(found.verdict == LARGER for found in compare(folders))
    assert wrong <= 12


def test_one_run_is_held_against_the_interval_of_several(tmp_path):
    values = [1.0, 1.1, 0.9, 1.05, 0.95]
    several = [report(tmp_path / f"{k}", k, value=value) for k, value in enumerate(values)]
    outer = stats.t.ppf(0.975, 4) * np.std(values, ddof=1) * np.sqrt(1 + 1 / 5)
    for name, value, verdict in (("in", 1 + 0.98 * outer, WITHIN), ("out", 1 + 1.02 * outer, LARGER)):
        (found,) = compare([*several, report(tmp_path / name, 9, 0.02, value=value)])
        assert found.verdict == verdict


def test_without_a_spread_nothing_is_said(tmp_path):
    one, other = report(tmp_path / "a", 0, value=1.0), report(tmp_path / "b", 0, 0.02, value=2.0)
    (found,) = compare([one, other])
    assert found.verdict == UNTOLD and "one run of each" in found.why
    (found,) = compare([one, report(tmp_path / "c", 1, value=1.0), other])
    assert found.verdict == UNTOLD and "no spread" in found.why


def test_seeds_make_no_group_and_settings_do(tmp_path):
    runs = read_compared([report(tmp_path / f"{k}", k, 0.01 + 0.01 * (k == 2), value=1.0) for k in range(4)])
    groups = groups_of(runs)
    assert [(group.name, len(group.runs)) for group in groups] == [("A", 3), ("B", 1)]
    (one,) = compared(runs)
    assert one.settings == {"controller task.speed": [0.01, 0.02]}
    paths = write_comparison([one], tmp_path / "out")
    kept = json.loads(paths[1].read_text())["arm"]
    assert kept["settings"] == {"controller task.speed": {"A": 0.01, "B": 0.02}}
    assert kept["groups"]["A"]["numbers"]["value"] == [1.0, 1.0, 1.0]
    assert "task.speed" in paths[0].read_text()


def test_runs_whose_settings_are_not_known_are_named(tmp_path):
    runs = read_compared([report(tmp_path / f"{k}", k, settings={}, value=1.0) for k in range(2)])
    (one,) = compared(runs)
    assert one.untold == [str(tmp_path / "0"), str(tmp_path / "1")]
    assert "settings are not recorded" in write_comparison([one], tmp_path / "out")[0].read_text()


@pytest.mark.parametrize("text, words", [("{", "is no JSON"), ("[1]", "no report of a run")])
def test_what_is_no_report_is_named(tmp_path, text, words):
    (tmp_path / "report.json").write_text(text)
    with pytest.raises(ValueError, match=words):
        read_compared([tmp_path])


def test_a_run_is_not_compared_with_itself(tmp_path):
    folder = report(tmp_path / "a", 0)
    with pytest.raises(ValueError, match="named twice"):
        read_compared([folder, folder / ".." / "a"])
