"""Signed distances, normals and contact geometry of the simulated surfaces."""

import time

import numpy as np
import pytest

from tactile_base.settings import SettingError
from tactile_drivers.sim.surfaces import SURFACES, contact_pose, make_surface

CASES = [
    ("plane", {}),
    ("ramp", {}),
    ("ramp", {"height": 0.08, "length": 0.1}),  # steep, curvature radius of 22 mm
    ("dome", {}),
    ("dome", {"radius": 0.03}),
]


def points_around(kind, parameters, seed, n=400):
    """Points above and below the surface, out to several times its size."""
    rng = np.random.default_rng(seed)
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


@pytest.mark.parametrize("kind, parameters", CASES)
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
    lift = np.array([0.0, 0.0, 0.01])
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


def test_the_ramp_of_the_default_settings_is_gentle():
    ramp = make_surface("ramp")
    assert 15.0 < np.degrees(ramp.max_slope) < 25.0
    assert ramp.min_curvature_radius > 0.1  # five times the tip's radius
    y = np.linspace(-0.02, 0.16, 20_001)
    slope, second = ramp.profile(y)[1:]
    assert np.degrees(np.arctan(np.abs(slope).max())) == pytest.approx(np.degrees(ramp.max_slope), rel=1e-6)
    assert 1.0 / np.abs(second).max() == pytest.approx(ramp.min_curvature_radius, rel=1e-6)


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


@pytest.mark.parametrize("kind", SURFACES)
def test_no_points_give_no_distances(kind):
    distance, normal = make_surface(kind).query(np.zeros((0, 3)))
    assert distance.shape == (0,)
    assert normal.shape == (0, 3)


@pytest.mark.parametrize("kind", SURFACES)
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
    with pytest.raises(SettingError, match=r"scene.yaml:3: unknown name 'rampe' \(did you mean 'ramp'\?\)"):
        make_surface("rampe", {}, "scene.yaml:3")


@pytest.mark.parametrize(
    "kind, parameters, message",
    [
        ("dome", {"radius": -0.1}, "radius = -0.1 m: must lie in"),
        ("dome", {"radus": 0.1}, "did you mean 'radius'"),
        ("ramp", {"height": "high"}, "must be of type float"),
        ("ramp", {"height": 0.2, "length": 0.1}, "slopes up to 75.1 degrees, must be at most 60"),
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


@pytest.mark.parametrize("kind, limit", [("plane", 0.15e-3), ("dome", 0.15e-3), ("ramp", 0.4e-3)])
def test_a_query_of_all_nodes_of_the_skin_is_cheap(kind, limit):
    surface = make_surface(kind)
    direction = np.random.default_rng(0).normal(size=(548, 3))
    tip = np.array([0.0, 0.0, 0.09]) if kind == "dome" else np.array([0.0, 0.06, 0.035])
    points = tip + 0.02 * direction / np.linalg.norm(direction, axis=1)[:, None]
    times = []
    for _ in range(200):
        start = time.thread_time()
        surface.query(points)
        times.append(time.thread_time() - start)
    assert np.quantile(times, 0.2) < limit  # other load on the machine must not fail this
