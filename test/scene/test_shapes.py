"""Signed distances, normals, meshes and contact geometry of the shapes."""

import subprocess
import sys

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial import cKDTree

from tactile_base.settings import SettingError
from tactile_scene.shapes import SHAPES, make_surface
from tactile_scene.shapes.surface import contact_pose

OPEN = [
    ("plane", {}),
    ("ramp", {}),
    ("ramp", {"height": 0.08, "length": 0.1}),  # steep, curvature radius of 22 mm
    ("dome", {}),
    ("dome", {"radius": 0.03}),
]
CLOSED = [
    ("sphere", {}),
    ("box", {"size": [0.057, 0.057, 0.057]}),
    ("box", {"size": [0.095, 0.19, 0.058], "rounding": 0.02}),
    ("box", {"size": [0.06, 0.08, 0.1], "rounding": 0.0}),
    ("box", {"size": [0.06, 0.06, 0.06], "rounding": 0.03}),  # a ball
    ("cylinder", {}),
    ("cylinder", {"axis": "x", "radius": 0.05, "height": 0.02}),
    ("cylinder", {"axis": "y"}),
    ("cylinder", {"axis": "y", "ends": False}),
    ("prism", {}),
    ("prism", {"sides": 3, "width": 0.05, "rounding": 0.0}),
    ("prism", {"sides": 5, "height": 0.04, "rounding": 0.01}),
]
CASES = OPEN + CLOSED


def points_around(kind, parameters, seed, n=400):
    """Points above and below the surface, out to several times its size."""
    rng = np.random.default_rng(seed)
    if (kind, parameters) in CLOSED:
        return rng.uniform(-0.15, 0.15, (n, 3))
    size = parameters.get("radius", 0.075) if kind == "dome" else parameters.get("length", 0.14)
    return rng.uniform([-size, -size, -0.8 * size], [size, 2 * size, 2 * size], (n, 3))


def dense_samples(kind, surface):
    """The curve that makes the surface by translation or rotation: (M, 2) of (horizontal, z)."""
    if kind == "dome":
        radius = surface.settings.radius
        angle = np.linspace(0.0, np.pi / 2, 200_001)
        cap = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        base = np.column_stack([np.linspace(radius, 10 * radius, 200_001), np.zeros(200_001)])
        return np.concatenate([cap, base])
    y = np.linspace(-1.0, 1.0, 400_001)
    z = np.zeros_like(y) if kind == "plane" else surface.profile(y)[0]
    return np.column_stack([y, z])


@pytest.mark.parametrize("kind, parameters", OPEN)
def test_distance_is_that_of_the_nearest_of_many_samples(kind, parameters):
    surface = make_surface(kind, parameters)
    points = points_around(kind, parameters, seed=1, n=120)
    horizontal = np.hypot(points[:, 0], points[:, 1]) if kind == "dome" else points[:, 1]
    flat = np.column_stack([horizontal, points[:, 2]])
    samples = dense_samples(kind, surface)
    nearest = np.array([np.sqrt(((samples - p) ** 2).sum(axis=1).min()) for p in flat])
    # samples lie 5 um apart: their nearest is farther by up to s^2 / 8d off the surface, s / 2 on it
    np.testing.assert_allclose(np.abs(surface.distance(points)), nearest, atol=3e-6)


@pytest.mark.parametrize("kind, parameters", CASES)
def test_distance_is_positive_above_and_negative_below(kind, parameters):
    surface = make_surface(kind, parameters)
    on_it = surface.grid(30).reshape(-1, 3)
    np.testing.assert_allclose(surface.distance(on_it), 0.0, atol=1e-13)
    lift = 0.1 * on_it if (kind, parameters) in CLOSED else np.array([0.0, 0.0, 0.01])
    above, below = on_it + lift, on_it - lift
    assert (surface.distance(above) > 0).all()
    assert (surface.distance(below) < 0).all()


@pytest.mark.parametrize("kind, parameters", CASES)
def test_normal_is_the_gradient_of_the_distance_and_has_unit_length(kind, parameters):
    surface = make_surface(kind, parameters)
    points = points_around(kind, parameters, seed=2)
    step = 1e-6
    gradient = np.stack(
        [
            (surface.distance(points + step * e) - surface.distance(points - step * e)) / (2 * step)
            for e in np.eye(3)
        ],
        axis=1,
    )
    # at the few points within a step of where the nearest point jumps, no gradient exists
    smooth = np.abs(np.linalg.norm(gradient, axis=1) - 1.0) < 1e-6
    assert smooth.mean() > 0.98
    normal = surface.normal(points)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(normal[smooth], gradient[smooth], atol=1e-6)


@pytest.mark.parametrize("kind, parameters", CASES)
def test_stepping_along_the_normal_by_the_distance_lands_on_the_surface(kind, parameters):
    surface = make_surface(kind, parameters)
    points = points_around(kind, parameters, seed=3)
    np.testing.assert_allclose(surface.distance(surface.closest(points)), 0.0, atol=1e-12)


@pytest.mark.parametrize("kind, parameters", [case for case in CLOSED if case[1].get("ends", True)])
def test_distance_is_that_of_the_nearest_point_of_a_fine_mesh(kind, parameters):
    surface = make_surface(kind, parameters)
    rng = np.random.default_rng(5)
    vertices, faces = surface.mesh(200)
    corners = vertices[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = rng.choice(len(faces), 400_000, p=area / area.sum())
    weights = rng.dirichlet([1.0, 1.0, 1.0], len(chosen))
    samples = np.einsum("ij,ijk->ik", weights, corners[chosen])
    points = rng.uniform(-0.15, 0.15, (300, 3))
    nearest = cKDTree(samples).query(points)[0]
    # chords of a mesh of 200 around lie up to 12 um inside; samples are 0.5 mm apart
    distance = np.abs(surface.distance(points))
    assert (nearest >= distance - 2e-5).all()
    assert (nearest <= distance + 1.5e-3).all()


@pytest.mark.parametrize("rounding", [0.0, 0.004])
def test_outside_a_box_the_distance_is_that_of_a_bounded_least_squares_problem(rounding):
    size = np.array([0.06, 0.08, 0.1])
    box = make_surface("box", {"size": list(size), "rounding": rounding})
    points = np.random.default_rng(6).uniform(-0.12, 0.12, (100, 3))
    half = size / 2 - rounding
    outside = points[(np.abs(points) > half + rounding).any(axis=1)]
    nearest = np.array([lsq_linear(np.eye(3), p, (-half, half), tol=1e-14).x for p in outside])
    expected = np.linalg.norm(outside - nearest, axis=1) - rounding
    np.testing.assert_allclose(box.distance(outside), expected, atol=1e-9)


def test_the_middle_of_a_closed_shape_is_its_smallest_half_extent_deep():
    middle = np.zeros((1, 3))
    assert make_surface("sphere", {"radius": 0.04}).distance(middle) == -0.04
    assert make_surface("cylinder", {"radius": 0.04, "height": 0.06}).distance(middle) == -0.03
    assert make_surface("box", {"size": [0.1, 0.2, 0.06]}).distance(middle) == pytest.approx(-0.03)
    for kind in ("sphere", "cylinder", "box"):
        assert np.linalg.norm(make_surface(kind).normal(middle)) == 1.0


def test_reading_the_names_of_the_shapes_loads_none_of_them():
    code = (
        "import sys; from tactile_scene.shapes import SHAPES; print(SHAPES.names()); "
        "assert 'numpy' not in sys.modules; "
        "assert not [name for name in sys.modules if name.startswith('tactile_scene.shapes.')]"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "'plane', 'ramp', 'dome', 'box', 'cylinder', 'sphere', 'prism'" in done.stdout


def test_the_ramp_of_the_default_settings_is_gentle():
    ramp = make_surface("ramp")
    y = np.linspace(-0.02, 0.16, 20_001)
    slope, second = ramp.profile(y)[1:]
    assert 15.0 < np.degrees(np.arctan(np.abs(slope).max())) < 25.0
    assert 1.0 / np.abs(second).max() > 0.1  # m, five times the tip's radius


def test_the_ramp_profile_is_twice_continuously_differentiable():
    ramp = make_surface("ramp")
    y = np.linspace(-0.01, 0.15, 160_001)
    h, slope, second = ramp.profile(y)
    np.testing.assert_allclose(np.gradient(h, y), slope, atol=1e-4)
    np.testing.assert_allclose(np.gradient(slope, y)[1:-1], second[1:-1], atol=1e-2)
    assert np.abs(np.diff(second)).max() < 0.01  # 1/m, between points 1 um apart


def test_one_point_far_away_does_not_change_what_others_get():
    ramp = make_surface("ramp")
    points = points_around("ramp", {}, seed=4, n=50)
    alone = np.array([ramp.distance(p[None])[0] for p in points])
    np.testing.assert_allclose(ramp.distance(points), alone, atol=1e-13)


@pytest.mark.parametrize("kind", SHAPES.names())
def test_no_points_give_no_distances(kind):
    distance, normal = make_surface(kind).query(np.zeros((0, 3)))
    assert distance.shape == (0,)
    assert normal.shape == (0, 3)


@pytest.mark.parametrize("kind", SHAPES.names())
def test_the_triangles_of_the_mesh_face_outward(kind):
    surface = make_surface(kind)
    vertices, faces = surface.mesh(20)
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    area_normal = np.cross(b - a, c - a)
    solid = np.linalg.norm(area_normal, axis=1) > 1e-12  # at the pole of the dome two corners coincide
    # a hair outside, since at the dome's foot the normal of the surface itself jumps
    normal = surface.normal((a + b + c)[solid] / 3 + 1e-3 * (kind == "dome") * (a + b + c)[solid])
    assert ((area_normal[solid] * normal).sum(axis=1) > 0).all()


def test_an_unknown_kind_names_the_valid_ones():
    with pytest.raises(SettingError, match=r"scene.yaml:3: shape: unknown name 'rampe' \(did you"):
        make_surface("rampe", {}, "scene.yaml:3")


@pytest.mark.parametrize(
    "kind, parameters, message",
    [
        ("dome", {"radius": -0.1}, "radius = -0.1 m: must lie in"),
        ("dome", {"radus": 0.1}, "did you mean 'radius'"),
        ("ramp", {"height": "high"}, "must be of type float"),
        ("ramp", {"height": 0.2, "length": 0.1}, "slopes up to 75.1 degrees, must be at most 60"),
        ("box", {"size": [0.1, 0.04, 0.1], "rounding": 0.03}, "at most half the shortest side, 0.02 m"),
        ("box", {"size": [0.1, 0.04]}, "size: must have 3 elements, has 2"),
        ("prism", {"width": 0.05, "rounding": 0.03}, "at most half of width and height, 0.025 m"),
        ("cylinder", {"axis": "w"}, "axis = 'w': must be one of x, y, z"),
    ],
)
def test_a_bad_parameter_is_refused(kind, parameters, message):
    with pytest.raises(SettingError, match=message):
        make_surface(kind, parameters)


def pose_at(point, normal, depth, tilt=0.0, radius=0.02):
    """Sensor `radius - depth` off `point`, z into the surface, then tilted about its x axis."""
    z = -np.asarray(normal)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    T[:3, :3] = T[:3, :3] @ np.array(
        [[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]]
    )
    T[:3, 3] = np.asarray(point) + (radius - depth) * np.asarray(normal)
    return T


@pytest.mark.parametrize(
    "kind, point", [("plane", [0.01, 0.02, 0]), ("ramp", [0, 0.06, 0]), ("dome", [0.02, 0.03, 1])]
)
@pytest.mark.parametrize("depth, tilt", [(0.003, 0.0), (0.0005, 0.4), (-0.01, -0.2)])
def test_contact_pose_returns_the_depth_and_tilt_it_was_built_from(kind, point, depth, tilt):
    surface = make_surface(kind)
    on_surface = surface.closest(np.array([point], dtype=float))
    normal = surface.normal(on_surface)[0]
    contact = contact_pose(surface, pose_at(on_surface[0], normal, depth, tilt), 0.02)
    assert contact.depth == pytest.approx(depth, abs=1e-12)
    assert contact.normal_angle == pytest.approx(abs(tilt), abs=1e-9)
    np.testing.assert_allclose(contact.point, on_surface[0], atol=1e-12)
    np.testing.assert_allclose(contact.normal, normal, atol=1e-10)
    np.testing.assert_allclose(contact.T_fs[:3, 3], [0, 0, depth], atol=1e-12)
    cos, sin = np.cos(tilt), np.sin(tilt)
    np.testing.assert_allclose(contact.T_fs[:3, :3], [[1, 0, 0], [0, cos, -sin], [0, sin, cos]], atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_contact_rotation_is_proper_and_has_no_turn_about_the_normal(seed):
    rng = np.random.default_rng(seed)
    T = pose_at([0, 0, 0], [0, 0, 1], 0.003)
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, :3] = q * np.sign(np.linalg.det(q))
    contact = contact_pose(make_surface("plane"), T, 0.02)
    R = contact.T_fs[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-13)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(0.0, abs=1e-13)  # gamma of extrinsic xyz
    np.testing.assert_allclose(T[:3, :3] @ R[2], [0, 0, -1], atol=1e-13)  # {f}'s z axis, back in the world
