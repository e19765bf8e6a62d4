"""What makes percepts of the frames of a simulated sensor, in the loop without ROS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from tactile_base.settings import SettingError
from tactile_perception.estimating.perceive import Perceiver, Percept
from tactile_scene.scene import Scene
from tactile_scene.simulation import INPUT
from tactile_sim.frame import Frame
from tactile_sim.network_view import ViewSettings

if TYPE_CHECKING:
    from tactile_perception.estimating.estimator import Estimator

Perception = Callable[[Frame], Percept]


def network_view(estimator: Estimator) -> ViewSettings:
    """What has to be known of a network to draw its input; `SettingError` where it cannot be drawn."""
    settings = estimator.metadata.preprocessing
    if settings.redraw_radius or settings.threshold_method != "mean":
        raise SettingError(
            f"{estimator.path}: fidelity '{INPUT}' is for networks with threshold_method mean and "
            f"redraw_radius 0, this one has {settings.threshold_method} and {settings.redraw_radius:g}; "
            "use image"
        )
    x0, y0, x1, y1 = settings.bbox
    return ViewSettings(
        bbox=(x0, y0, x1, y1),
        median=settings.median,
        block=settings.threshold_block,
        offset=settings.threshold_offset,
        circle=settings.circle_mask_radius,
        size=settings.size,
    )


def perception(scene: Scene, arm: str, model: Path | None) -> tuple[Perception | None, ViewSettings | None]:
    """What makes percepts of an arm's frames, the network or the sensor itself, and how the former sees."""
    if scene.arms[arm].sensor is None:
        return None, None
    if not scene.gives_images(arm):
        return _own_answer, None
    # here, since runs without images do without onnxruntime
    from tactile_perception.estimating.estimator import Estimator
    from tactile_perception.estimating.presence import ContactPresence

    drawn = scene.simulation.sensors[arm].at_input
    estimator = Estimator(model or scene.model_file(arm) or "")
    perceiver = Perceiver(estimator, ContactPresence())

    def perceive(frame: Frame) -> Percept:
        assert frame.image is not None
        return perceiver(frame.image, drawn, frame.stamp_ns)

    return perceive, network_view(estimator) if drawn else None


def _own_answer(frame: Frame) -> Percept:
    """The percept of a sensor that gives estimates."""
    touches = frame.estimate is not None
    return Percept(touches, float(touches), frame.estimate, plain_depth=frame.plain_depth)
