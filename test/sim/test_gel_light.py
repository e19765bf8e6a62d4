"""A dome of gel in colored light: its shading, and that a contact shows where it is."""

import numpy as np

from tactile_geometry import se3
from tactile_scene.shapes.plane import Plane
from tactile_scene.simulated_sensors import CameraSettings, LightSettings, MarkerSettings, TacTipSettings
from tactile_sim.camera import Camera
from tactile_sim.collection import load_sensor
from tactile_sim.gel_light import GelLight
from tactile_sim.skin import load_skin
from tactile_sim.tactip import TacTip

CAMERA = CameraSettings(
    width=320, height=240, center_column=160.0, center_row=120.0, focal_length=448.0, distortion=(0.5, -2.0),
    rotation_deg=30.0, vignette=0.0, noise_gray=0.0,
)  # fmt: skip
LIGHT = LightSettings(lamp_gray=100.0, ambient_gray=20.0, azimuth_deg=0.0)


def pressed(sensor: TacTip, depth: float, x: float = 0.0) -> None:
    tilt = np.arcsin(x / 0.02)
    for height in (1e-3, -depth):
        sensor.advance(Plane(), se3.pose_from_euler([0.0, 0.0, 0.02 + height, np.pi, tilt, 0.0]))


def test_through_the_lens_a_pixel_sees_the_point_that_is_projected_to_it():
    camera = Camera(CAMERA)
    points = np.random.default_rng(0).uniform([-0.012, -0.012, 0.005], [0.012, 0.012, 0.02], (50, 3))
    found = camera.directions(camera.project(points)[0], 20)
    np.testing.assert_allclose(found, points[:, :2] / (CAMERA.distance + points[:, 2:]), atol=1e-9)


def test_at_rest_each_color_is_that_of_a_matt_sphere():
    """Lambert's law on the inside of a sphere, at points whose pixels the camera itself tells."""
    skin, camera = load_skin(), Camera(CAMERA)
    radius = 0.02
    light = GelLight(LIGHT, camera, skin, radius)
    grounds = light.grounds(np.zeros((len(skin.nodes), 3), np.float32))
    angles = np.random.default_rng(1).uniform([0.05, 0.0], [0.7, 2 * np.pi], (40, 2))
    polar, azimuth = angles.T
    normal = np.column_stack(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )
    column, row = np.rint(camera.project(radius * normal)[0]).astype(int).T
    for ground, turn in zip(grounds, (240.0, 120.0, 0.0), strict=True):  # blue, green, red
        lamp = radius * np.array([np.cos(np.radians(turn)), np.sin(np.radians(turn)), 0.0])
        way = lamp - radius * normal
        distance = np.linalg.norm(way, axis=1)
        cosine = np.maximum(0.0, -np.sum(way * normal, axis=1) / distance)
        expected = 20.0 + 100.0 * cosine * (radius / distance) ** 2
        np.testing.assert_allclose(ground[row, column], expected, rtol=0.03)


def test_a_contact_changes_the_image_where_it_is_and_the_more_the_deeper():
    settings = TacTipSettings(camera=CAMERA, light=LIGHT, markers=MarkerSettings(rings=0))
    sensor = TacTip(settings)
    rest = sensor.image().astype(float)
    assert rest.shape == (240, 320, 3) and len(sensor.marker_positions) == 0
    changes = []
    for depth in (1e-3, 3e-3):
        pressed(sensor, depth)
        changes.append(np.abs(sensor.image() - rest).sum(axis=2))
    assert changes[1].sum() > 2.0 * changes[0].sum()
    middle = np.mgrid[:240, :320].reshape(2, -1) @ changes[1].ravel() / changes[1].sum()
    np.testing.assert_allclose(middle, [120, 160], atol=6)
    pressed(sensor, 3e-3, x=6e-3)
    beside = np.abs(sensor.image() - rest).sum(axis=2)
    moved = np.mgrid[:240, :320].reshape(2, -1) @ beside.ravel() / beside.sum() - middle
    assert np.linalg.norm(moved) > 10.0


def test_markers_may_be_drawn_on_lit_gel():
    plain = TacTip(TacTipSettings(camera=CAMERA, light=LIGHT, markers=MarkerSettings(rings=0))).image()
    dotted = TacTip(TacTipSettings(camera=CAMERA.replaced(marker_gray=0.0), light=LIGHT)).image()
    darker = (dotted.astype(int) < plain.astype(int) - 10).any(axis=2).mean()
    assert 0.05 < darker < 0.5


def test_the_packaged_dome_of_gel_is_deterministic_by_seed():
    sensor = load_sensor("gel_dome").sensor
    first, same, other = (TacTip(sensor, seed=seed).image() for seed in (3, 3, 4))
    assert np.array_equal(first, same) and not np.array_equal(first, other)
    assert first.mean(axis=(0, 1)).min() > 20
