"""Markers and their density on top of the image, of whatever size it is, and words where there are none."""

import cv2
import numpy as np
import pytest
import viser
from browser import wait
from cell_messages import messages

from tactile_bringup.launching.page_process import free_port
from tactile_view.cell_state import CellState
from tactile_view.marker_picture import marker_picture
from tactile_view.panels import MARKERS, PLAIN, TouchPanel
from tactile_wire.message_definitions import installed_typestore

APART, FURTHER = 20, 30  # px, of markers to the left and to the right
CORNERS = 4  # of those to the right, which have too few neighbours to be told from specks
PLACES = [(x, y) for x in range(40, 300, APART) for y in range(40, 440, APART)]
PLACES += [(x, y) for x in range(320, 600, FURTHER) for y in range(40, 440, FURTHER)]


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    image = np.full((480, 640), 10, np.uint8)
    for place in PLACES:
        cv2.circle(image, place, 5, 200, -1)
    return image


@pytest.mark.parametrize("factor", [0.25, 0.75, 1.0, 3.0])
def test_each_marker_is_found_whatever_the_size_and_glows_where_they_are_dense(image, factor):
    picture, words = marker_picture(
        cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    )
    count, apart = int(words.split()[0]), float(words.split()[2])
    assert len(PLACES) - CORNERS <= count <= len(PLACES)
    assert factor * APART < apart < factor * FURTHER
    assert picture.dtype == np.uint8 and picture.shape == (360, 480, 3)
    left, right = picture[90:270, 60:200, 0], picture[90:270, 270:420, 0]  # red
    assert np.median(left) > np.median(right) + 30


@pytest.mark.parametrize("shape", [(1, 1), (48, 64), (1, 1920), (2000, 10), (480, 640)])
def test_an_image_without_markers_is_shown_and_it_is_said(shape):
    picture, words = marker_picture(np.full(shape, 90, np.uint8))
    assert words.startswith("no density: 0 markers found") and (picture == 90).all()


def test_rows_that_are_padded_are_no_matter(image):
    np.testing.assert_array_equal(marker_picture(image[:, :600])[0], marker_picture(image[:, :600].copy())[0])


def test_a_choice_on_the_page_shows_them_also_of_an_image_that_stands_still():
    state = CellState()
    for message in messages(0.1):
        state.take(*message)
    server = viser.ViserServer(host="127.0.0.1", port=free_port("127.0.0.1"), verbose=False)
    try:
        panel = TouchPanel(server, installed_typestore)
        for choice, shape, said in (
            (PLAIN, (48, 64, 3), False),
            (MARKERS, (360, 480, 3), True),
            (PLAIN, (48, 64, 3), False),
        ):
            panel.choice.value = choice  # which a thread of the server's hears
            arm = state.arms["arm"]
            assert wait(lambda arm=arm, shape=shape: panel.show(arm) or panel._image.image.shape == shape)
            assert ("no density: 0 markers found" in panel._words.content) == said
    finally:
        server.stop()
