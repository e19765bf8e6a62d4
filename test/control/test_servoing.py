"""Tactile servoing: signs and frames by hand, the two tangent spaces against each other, convergence."""

import numpy as np
import pytest

from tactile_control.pid import PidSettings
from tactile_control.servoing import ServoingController, ServoingSettings
from tactile_geometry import se3

KP = PidSettings(kp=[2.0] * 6)
DEPTH_3MM = ServoingSettings(reference=[0.0, 0.0, 0.003, 0.0, 0.0, 0.0])


def feature_pose(x=0.0, y=0.0, z=0.003, alpha=0.0, beta=0.0, gamma=0.0):
    return se3.inverse(se3.pose_from_euler(np.array([x, y, z, alpha, beta, gamma])))


def serve(X_sf, settings=DEPTH_3MM, pid=KP, velocity=(0.0,) * 6):
    return ServoingController(settings, pid).step(0, X_sf, velocity)


def test_too_shallow_a_contact_pushes_along_the_sensors_z():
    np.testing.assert_allclose(serve(feature_pose(z=0.001)).twist, [0, 0, 2.0 * 0.002, 0, 0, 0], atol=1e-13)


def test_a_tilted_sensor_turns_back():
    twist = serve(feature_pose(alpha=0.1)).twist
    np.testing.assert_allclose(twist[3:], [-0.2, 0, 0], atol=1e-12)


def test_error_is_zero_at_the_reference_and_feedforward_passes_through():
    velocity = np.array([0.003, 0.01, 0.0, 0.0, 0.0, 0.0])
    out = serve(feature_pose(), velocity=velocity)
    np.testing.assert_allclose(out.error, 0.0, atol=1e-13)
    np.testing.assert_allclose(out.twist, velocity, atol=1e-13)


def test_feedforward_stays_tangential_to_the_surface_when_the_sensor_is_tilted():
    X_sf = feature_pose(alpha=0.3, beta=-0.2)
    out = serve(X_sf, pid=PidSettings(), velocity=[0.0, 0.01, 0, 0, 0, 0])
    in_feature_frame = se3.inverse(X_sf)[:3, :3] @ out.twist[:3]
    np.testing.assert_allclose(in_feature_frame, [0.0, 0.01, 0.0], atol=1e-13)


def test_feedback_is_the_log_of_the_papers_error_pose():
    X_sf, reference = feature_pose(0.001, -0.002, 0.004, 0.1, -0.2, 0.05), feature_pose()
    expected = se3.log(X_sf @ se3.inverse(reference))
    np.testing.assert_allclose(serve(X_sf).error, expected, atol=1e-13)
    np.testing.assert_allclose(serve(X_sf).twist, 2.0 * expected, atol=1e-13)


def test_local_and_global_agree_where_all_gains_are_equal():
    X_sf = feature_pose(0.002, -0.001, 0.004, 0.2, 0.1, -0.1)
    velocity = [0.002, 0.01, -0.001, 0.01, 0.02, 0.03]
    other = ServoingSettings(reference=DEPTH_3MM.reference, tangent_space="global")
    np.testing.assert_allclose(
        serve(X_sf, velocity=velocity).twist, serve(X_sf, other, velocity=velocity).twist, atol=1e-12
    )


@pytest.mark.parametrize("space", ["local", "global"])
def test_servoing_converges_to_the_reference_from_a_sheared_tilted_contact(space):
    settings = ServoingSettings(reference=[0.0, 0.0, 0.003, 0.0, 0.0, 0.0], tangent_space=space)
    controller = ServoingController(settings, KP)
    X_fs = se3.pose_from_euler(np.array([0.002, -0.003, 0.005, 0.3, -0.2, 0.1]))
    for k in range(600):
        twist = controller.step(k * 16_000_000, se3.inverse(X_fs)).twist
        X_fs = X_fs @ se3.exp(twist * 0.016)
    np.testing.assert_allclose(X_fs, se3.pose_from_euler(np.array(settings.reference)), atol=1e-6)


def test_with_free_shear_only_depth_and_tilt_are_errors():
    settings = ServoingSettings(free_shear=True)
    euler = np.array([0.004, -0.003, 0.003, 0.0, 0.0, 0.1])
    np.testing.assert_allclose(serve(feature_pose(*euler), settings).error, 0.0, atol=1e-13)
    tilted = serve(feature_pose(0.004, -0.003, 0.003, 0.1, 0.0, 0.0), settings)
    np.testing.assert_allclose(tilted.error, [0, 0, 0, -0.1, 0, 0], atol=1e-13)


@pytest.mark.parametrize(
    "X_sf, message",
    [
        (np.full((4, 4), np.nan), "X_sf is not finite"),
        (np.eye(3), r"X_sf: shape \(3, 3\), must be \(4, 4\)"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "X_sf is not a rigid transform"),
        (np.diag([2.0, 1.0, 1.0, 1.0]), "X_sf is not a rigid transform"),
    ],
)
def test_a_pose_that_is_none_is_refused(X_sf, message):
    with pytest.raises(se3.PoseError, match=message):
        serve(X_sf)
