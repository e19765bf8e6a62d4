"""A recording on the page in a real browser: the scene is drawn, the image moves, the time line seeks."""

import itertools

import pytest
from browser import Viewer, chromium, wait
from cell_messages import record

pytestmark = pytest.mark.live  # against the clock: a browser that draws in software


@pytest.fixture(scope="module")
def viewer(tmp_path_factory):
    folder = tmp_path_factory.mktemp("viewed")
    bag = record(folder / "bag", 12.0, note={"scene_file": "plane"})
    with chromium() as browser:
        viewer = Viewer(browser, folder, str(bag), "--port", "0")
        yield viewer
        viewer.close()


def test_the_scene_is_drawn_and_the_numbers_stand_beside_it(viewer):
    assert viewer.sees("follow") and viewer.sees("depth 3.00 mm")
    assert viewer.is_drawn(), "the scene is empty"


def test_the_tactile_image_moves(viewer):
    viewer.page.get_by_role("tab", name="Touch").click()
    viewer.page.get_by_text("play / pause").click()  # it may have come to its end: from the start again
    if "paused" in viewer.text():
        viewer.page.get_by_text("play / pause").click()
    first = viewer.images()
    assert wait(lambda: viewer.images() != first)


def still(viewer: Viewer) -> bool:
    """Whether the images stay as they are; at first one may be on its way to the browser."""
    before = viewer.images()
    viewer.page.wait_for_timeout(700)
    return viewer.images() == before


def test_pause_holds_it_and_frames_are_stepped(viewer):
    if "paused" not in viewer.text():
        viewer.page.get_by_text("play / pause").click()
    assert viewer.sees("paused")
    assert wait(lambda: still(viewer)), "it goes on"
    held, clicks = viewer.images(), itertools.count()

    def stepped() -> bool:
        """An image comes each six exposures, and clicks that follow fast are one for the page.

        Back, since on a slow machine it has come to its end; then on, since it may be at its first image.
        """
        viewer.page.get_by_text("◀ frame" if next(clicks) % 40 < 20 else "frame ▶").click()
        viewer.page.wait_for_timeout(100)
        return viewer.images() != held

    assert wait(stepped)


def test_the_phases_are_listed_with_their_times(viewer):
    viewer.page.get_by_role("tab", name="Phases").click()
    assert viewer.sees("0.50 s phase: arm: follow")
