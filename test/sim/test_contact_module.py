"""The C module of the simulated sensor: arrays it cannot use are refused, odd numbers have a result."""

import numpy as np
import pytest

from tactile_sim import _contact
from tactile_sim.limit_surface import Foot

NODES, ACTIVE = 4, 2


def arrays() -> dict[str, np.ndarray]:
    """Two of four nodes pressed 1 mm into a wall at 1 mm/N, each on its own."""
    return {
        "force": np.zeros((ACTIVE, 3)),
        "state": np.zeros(ACTIVE, np.uint8),
        "residual": np.tile(np.float32([0.0, 0.0, -1e-3]), (ACTIVE, 1)),
        "normal": np.tile([0.0, 0.0, 1.0], (ACTIVE, 1)),
        "compliance": (1e-3 * np.eye(3 * NODES)).astype(np.float32),
        "active": np.int32([0, 3]),
    }


def solve(**changed) -> dict[str, np.ndarray]:
    used = {**arrays(), **changed}
    _contact.solve(*used.values(), 0.5, 20, 1e-9)
    return used


def read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def swapped(array: np.ndarray) -> np.ndarray:
    """The same numbers in the other byte order."""
    return array.astype(array.dtype.newbyteorder())


def unaligned(array: np.ndarray) -> np.ndarray:
    """The same numbers one byte beside where they should lie."""
    memory = np.zeros(array.nbytes + 1, np.uint8)
    memory[1:] = array.view(np.uint8).ravel()
    return memory[1:].view(array.dtype).reshape(array.shape)


def test_a_pressed_node_is_pushed_back_by_its_depth():
    used = solve()
    np.testing.assert_allclose(used["force"], [[0, 0, 1], [0, 0, 1]], atol=1e-6)
    out = np.ones((NODES, 3), np.float32)
    _contact.displacement(out, used["force"], used["compliance"], used["active"])
    np.testing.assert_allclose(out[:, 2], [1e-3, 0, 0, 1e-3], atol=1e-9)


def test_no_contact_at_all_moves_nothing():
    none = {name: array[:0] for name, array in arrays().items() if name != "compliance"}
    solve(**none)
    out = np.ones((NODES, 3), np.float32)
    _contact.displacement(out, none["force"], arrays()["compliance"], none["active"])
    assert not out.any()


@pytest.mark.parametrize("name", ["force", "state", "residual"])
def test_results_are_not_written_where_that_is_forbidden(name):
    with pytest.raises(ValueError, match=f"{name} is read-only"):
        solve(**{name: read_only(arrays()[name])})


@pytest.mark.parametrize("layout", [swapped, unaligned, lambda a: np.repeat(a, 2, axis=0)[::2]])
@pytest.mark.parametrize("name", ["force", "residual", "normal", "compliance", "active"])
def test_another_layout_in_memory_is_refused(name, layout):
    with pytest.raises(TypeError, match=f"{name}: .* contiguous, aligned and in native byte order"):
        solve(**{name: layout(arrays()[name])})


@pytest.mark.parametrize("node", [-1, NODES])
def test_a_node_that_is_not_there_is_refused(node):
    with pytest.raises(IndexError, match=rf"active\[1\] = {node}: must lie in 0..3"):
        solve(active=np.int32([0, node]))


@pytest.mark.parametrize(
    "name, array", [("force", np.zeros((3, 3))), ("compliance", np.zeros((12, 9), np.float32))]
)
def test_shapes_that_do_not_fit_are_refused(name, array):
    with pytest.raises(ValueError, match=name):
        solve(**{name: array})


def render(blobs, softness: float = 1.0, **changed) -> np.ndarray:
    used = {
        "image": np.full((6, 8), 77, np.uint8),
        "background": np.full((6, 8), 10.0, np.float32),
        "canvas": np.empty((6, 8), np.float32),
        **changed,
    }
    blobs = np.array(blobs, np.float64).reshape(-1, 4)
    _contact.render(used["image"], used["background"], blobs, softness, None, 0, used["canvas"])
    return used["image"]


def test_discs_beyond_the_border_are_cut_off():
    image = render([[0, 0, 1.5, 200], [7, 5, 1.5, 200], [-50, 2, 3, 200], [1e300, 2, 3, 200]])
    assert image[0, 0] == image[5, 7] == 200
    assert image[0, 7] == image[5, 0] == image[2, 0] == image[2, 7] == 10


@pytest.mark.parametrize("place", [0, 1, 2])
def test_a_disc_of_no_place_or_size_is_not_drawn(place):
    blob = [4.0, 3.0, 2.0, 200.0]
    blob[place] = np.nan
    assert (render([blob]) == 10).all()


def test_gray_levels_that_no_pixel_has_are_cut_off_and_nan_is_black():
    levels = np.float32([[-1e9, -1.0, 254.6, 1e9, np.inf, -np.inf, np.nan, 3.4]])
    image = render([], image=np.zeros((1, 8), np.uint8), background=levels, canvas=np.zeros_like(levels))
    assert image.tolist() == [[0, 0, 255, 255, 255, 0, 0, 3]]


def test_a_disc_without_a_soft_edge_is_drawn():
    image = render([[4, 3, 2, 200]], softness=0.0)
    assert image[3, 4] == 200 and image[3, 5] == 200 and image[3, 7] == 10


@pytest.mark.parametrize("name", ["image", "canvas"])
def test_nothing_is_drawn_where_that_is_forbidden(name):
    shape = {"image": np.zeros((6, 8), np.uint8), "canvas": np.zeros((6, 8), np.float32)}
    with pytest.raises(ValueError, match=f"{name} is read-only"):
        render([], **{name: read_only(shape[name])})


def pushed():
    square = Foot.around([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    return _contact.PushedBody(square.numbers, square.arm, np.eye(4), [0, 0, 1], 5, 0.3, [0, 0], 0, 0, 0.9)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([np.eye(4)], "a pose and a tip for each"),
        ([np.eye(4), b"short"], "what the method of this name answers"),
        ([np.eye(3), b""], r"T_world_tool: must have shape \(4, 4\)"),
    ],
)
def test_a_pushed_object_takes_no_tip_that_is_none(arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        pushed().step(*arguments)


def test_a_pushed_object_refuses_numbers_that_are_not_finite_and_a_foot_of_another_form():
    with pytest.raises(ValueError, match="force: must be finite"):
        pushed().tip(np.eye(4), np.eye(4), [0, 0, 0], [0, 0, 1], [0, np.nan, 0], 1.0, 1.0)
    with pytest.raises(ValueError, match=r"edges: must have shape \(n, 5\)"):
        _contact.foot_inside((np.zeros((3, 4)), np.zeros(2), np.eye(2)), [0, 0])
