"""`tactile data check` on real TacTip images: their conventions are the paper's, and flipped signs are found.

The published data are not part of the project: see test_real_tactip.py.
"""

import os
from pathlib import Path

import pytest

from tactile_perception.datasets.conventions import Explanation, find_conventions
from tactile_perception.datasets.dataset import open_folder
from tactile_perception.datasets.statistics import label_statistics
from tactile_perception.estimating.labels import EULER_COMPONENTS
from tactile_perception.markers.flow import FlowSettings, MarkerFlow, flow_of, measure

DATA = Path(os.environ.get("TACTILE_REAL_DATA", Path(__file__).parents[2].parent / "shared" / "data"))
VAL = DATA / "tactip_franka" / "val"
pytestmark = pytest.mark.skipif(
    not (VAL / "targets_images.csv").is_file(),
    reason=f"no real TacTip data at {VAL} (set TACTILE_REAL_DATA)",
)


@pytest.fixture(scope="module")
def flow() -> MarkerFlow:
    return measure(open_folder(VAL), FlowSettings(samples=400))


def test_the_published_data_follow_the_papers_conventions(flow):
    found = find_conventions(flow)
    assert found.uncertain == [] and found.depth_flipped is False
    assert found.explanations == [Explanation()]
    assert (found.length_unit, found.angle_unit) == ("mm", "deg")
    assert flow.found > 0.85


@pytest.mark.parametrize("name", ["x", "y", "alpha", "beta", "gamma"])
def test_a_sign_flipped_on_purpose_is_found(flow, name):
    labels = flow.labels.copy()
    labels[:, EULER_COMPONENTS.index(name)] *= -1.0
    found = find_conventions(flow_of(flow.positions, labels, flow.rest, flow.deeper))
    assert found.explanations == [Explanation((name,))]


def test_the_published_labels_are_even_balanced_and_sorted_by_depth():
    found = label_statistics(open_folder(VAL).euler_mm_deg)
    assert all(spread.even for spread in found.spreads) and found.sorted_by == "z"
    assert not (found.constant or found.off_center or found.correlated or found.repeated or found.outliers)
