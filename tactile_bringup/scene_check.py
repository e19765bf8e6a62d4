"""Shapes and motions of other packages in a scene, tried before a run: not all call `tactile check`."""

from __future__ import annotations

from collections.abc import Iterator

from tactile_base.raised import defined_in, plugin_name, told
from tactile_base.settings import SettingError
from tactile_bringup.plugin_check import Problems, Unusable, try_motion, try_shape
from tactile_scene.motions import MOTIONS
from tactile_scene.scene import Scene
from tactile_scene.shapes import SHAPES
from tactile_sim.motions import make_motion


def check_bodies(scene: Scene) -> list[str]:
    """What they do not keep of their contracts, each with the plug-in's name and file; none of ours is tried.

    Raises `SettingError` for what no run can be made with.
    """
    remarks = []
    for kind, problems in _tries(scene):
        try:
            found = list(problems)
        except Exception as error:  # somebody else's code may raise anything
            raise SettingError(f"{scene.path}: {told(error, kind)}") from error
        texts = [f"{plugin_name(kind)}: {problem} ({defined_in(kind)})" for problem in found]
        bad = [text for text, problem in zip(texts, found, strict=True) if isinstance(problem, Unusable)]
        if bad:
            raise SettingError(f"{scene.path}: {bad[0]}")
        remarks += texts
    return remarks


def _tries(scene: Scene) -> Iterator[tuple[type, Problems]]:
    for name, body in scene.bodies.items():
        shape, motion = SHAPES.load(body.shape), MOTIONS.load(body.motion)
        if plugin_name(shape):
            yield shape, try_shape(shape(body.parameters))
        if plugin_name(motion):
            yield motion, try_motion(lambda body=body: make_motion(scene, body), scene, name)  # type: ignore[misc]
