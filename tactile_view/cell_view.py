"""CellView: the cell in three dimensions: arms, tips, surfaces, believed contacts with their uncertainty.

What is shown comes from a `CellState` and, where there is one, from the scene file: shapes of bodies, where
arms stand, links of known arms. Lengths are metres; a cell of the grid is 10 mm, a thick line of it 100 mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from tactile_geometry import se3
from tactile_geometry.gaussian import ros_from_left
from tactile_scene.scene import ArmScene, Scene
from tactile_sim.skin_force import SkinModel, largest_shear
from tactile_view.cell_state import ArmState, CellState
from tactile_view.drawing import ROUND, STALK, cone, dome, look_from, place, se3_of, way_ahead
from tactile_view.urdf_meshes import UrdfMeshes

Array = NDArray[Any]

TIP_RADIUS = 0.020  # m, where no scene says it
ARM_COLOR, TIP_COLOR, BODY_COLOR, PATH_COLOR = (90, 96, 104), (235, 120, 40), (130, 145, 160), (40, 110, 200)
BELIEF_COLOR, TRUTH_COLOR, SHEAR_COLOR, TWIST_COLOR = (
    (30, 120, 220),
    (20, 150, 60),
    (200, 30, 120),
    (120, 60, 200),
)
FIELD = 0.75  # rad, of the camera
LINK = 0.07  # m, thickness of a link
SHEAR_SCALE = 10.0  # an arrow of 10 mm is a shear of 1 mm
TWIST_SECONDS = 2.0  # an arrow is as long as the way in so many seconds
GOAL_RADIUS = 2e-3  # m
LEAST_ARROW = 1e-4  # m; shorter ones are none
_MESH = 60  # points of a surface along an edge


@dataclass
class ViewOptions:
    """What is shown, and how large what is small."""

    truth: bool = True
    path: bool = True
    twist: bool = True
    friction: bool = True
    uncertainty: float = 10.0


class CellView:
    """See the module's text."""

    def __init__(self, server: viser.ViserServer, scene: Scene | None) -> None:
        self._scene3d = server.scene
        self.options = ViewOptions()
        self._arms: dict[str, _ArmView] = {}
        server.scene.set_up_direction("+z")
        server.scene.configure_default_lights(enabled=True)
        server.scene.add_grid(
            "/grid", width=2.0, height=2.0, cell_size=0.01, section_size=0.1, cell_color=(232, 232, 232),
            section_color=(200, 200, 200), position=(0.0, 0.0, -1e-3),
        )  # fmt: skip
        self.set_scene(scene)
        eye, middle = look_from(self.tips(CellState()))
        server.initial_camera.position = tuple(eye.tolist())
        server.initial_camera.look_at = tuple(middle.tolist())
        server.initial_camera.near, server.initial_camera.fov = 1e-3, FIELD

    def set_scene(self, scene: Scene | None) -> None:
        """Show what stands in this cell."""
        self._scene = scene
        for view in self._arms.values():
            view.remove()
        self._arms.clear()
        self._bodies = {} if scene is None else {name: self._add_body(name) for name in scene.bodies}

    def _add_body(self, name: str) -> Any:
        assert self._scene is not None
        vertices, faces = self._scene.bodies[name].make().mesh(_MESH)
        node = self._scene3d.add_mesh_simple(
            f"/bodies/{name}", vertices, faces, color=BODY_COLOR, side="double", opacity=0.85
        )
        place(node, self._scene.T_world_body(name))
        return node

    def tips(self, state: CellState) -> list[Array]:
        """Where the sensors are, T_world_sensor (4, 4), or will start; none where nobody knows."""
        tips = [
            np.asarray(arm.T_world_base @ pose["T_base_sensor"])
            for arm in state.arms.values()
            if (pose := arm.newest("pose")) is not None
        ]
        if not tips and self._scene is not None:
            tips = [arm.T_world_start for arm in self._scene.arms.values()]
        return tips

    def skin(self, arm: str) -> SkinModel | None:
        """The skin of an arm's sensor as it is simulated; None of a real one, and where nobody says."""
        described = None if self._scene is None else self._scene.arms.get(arm)
        if self._scene is None or described is None or not described.simulated_sensor:
            return None
        return self._scene.simulation.sensors[arm].model

    @property
    def remarks(self) -> dict[str, str]:
        """Arm -> why it is not shown as its scene says."""
        return {name: view.remark for name, view in self._arms.items() if view.remark}

    def show(self, state: CellState) -> None:
        """Show the cell as it is known now."""
        for name, arm in state.arms.items():
            if name not in self._arms:
                described = None if self._scene is None else self._scene.arms.get(name)
                self._arms[name] = _ArmView(self._scene3d, name, described, self.skin(name))
            self._arms[name].show(arm, self.options)
        for name, node in self._bodies.items():
            place(node, self._T_world_body(name, state))

    def _T_world_body(self, name: str, state: CellState) -> Array:
        assert self._scene is not None
        if name in state.bodies:
            return state.bodies[name]
        body = self._scene.bodies[name]
        arm = state.arms.get(body.carried_by)
        pose = None if arm is None else arm.newest("pose")
        if arm is None or pose is None:
            return self._scene.T_world_body(name)
        T_controlled_tool = se3.inverse(self._scene.arms[arm.name].T_tool_controlled)
        return np.asarray(arm.T_world_base @ pose["T_base_sensor"] @ T_controlled_tool @ body.T_parent_body)


class _ArmView:
    """One arm with all that belongs to it; its nodes stand in its base."""

    def __init__(self, scene3d: Any, name: str, arm: ArmScene | None, skin: SkinModel | None) -> None:
        self._scene3d, self._root, self._arm, self._skin = scene3d, f"/arms/{name}", arm, skin
        self._feels = arm is None or arm.sensor is not None
        radius = TIP_RADIUS if arm is None or arm.sensor is None else arm.sensor.settings.tip_radius
        self._base = scene3d.add_frame(self._root, show_axes=False)
        self._tip = scene3d.add_frame(f"{self._root}/tip", axes_length=0.03, axes_radius=8e-4)
        vertices, faces = dome(radius)
        scene3d.add_mesh_simple(
            f"{self._root}/tip/dome", vertices, faces, color=TIP_COLOR, opacity=0.6, side="double",
            visible=self._feels,
        )  # fmt: skip
        stalk = np.array([[[0.0, 0.0, -STALK], [0.0, 0.0, -radius if self._feels else 0.0]]])
        self._line(f"{self._root}/tip/stalk", stalk, ARM_COLOR, 0.025)
        self._links = self._line(f"{self._root}/links", np.zeros((1, 2, 3)), ARM_COLOR, LINK)
        self.remark = ""
        self._meshes = self._add_meshes()
        self._path = self._line(f"{self._root}/path", np.zeros((1, 2, 3)), PATH_COLOR, 1e-3)
        self._ahead = self._line(f"{self._root}/ahead", np.zeros((1, 2, 3)), TWIST_COLOR, 6e-4)
        self._goal = scene3d.add_icosphere(
            f"{self._root}/goal", GOAL_RADIUS, color=TWIST_COLOR, visible=False
        )
        self._contact = scene3d.add_frame(f"{self._root}/contact", axes_length=0.02, axes_radius=6e-4)
        self._ellipsoid = scene3d.add_icosphere(
            f"{self._root}/contact_position", 1.0, color=BELIEF_COLOR, opacity=0.45
        )
        self._normals = self._line(f"{self._root}/contact/normals", np.zeros((1, 2, 3)), BELIEF_COLOR, 4e-4)
        self._shear = self._arrow("shear", SHEAR_COLOR)
        self._friction = self._line(f"{self._root}/contact/friction", np.zeros((1, 2, 3)), SHEAR_COLOR, 4e-4)
        self._reference = scene3d.add_frame(
            f"{self._root}/reference", axes_length=0.015, axes_radius=4e-4, origin_color=TWIST_COLOR
        )
        self._truth = scene3d.add_frame(
            f"{self._root}/truth", axes_length=0.025, axes_radius=3e-4, origin_color=TRUTH_COLOR
        )
        self._twist = self._arrow("twist", TWIST_COLOR)
        scene3d.add_label(f"{self._root}/tip/name", name, position=(0.0, 0.0, -STALK))

    def _add_meshes(self) -> UrdfMeshes | None:
        """Of an arm that a URDF describes; its links are drawn where that is not possible."""
        chain = None if self._arm is None else self._arm.kinematics
        if chain is None or chain.description is None:
            return None
        try:
            return UrdfMeshes(self._scene3d, self._root, chain.description, ARM_COLOR)
        except (OSError, ValueError) as error:
            self.remark = f"its meshes are not shown: {error}"
            return None

    def _line(self, name: str, points: Array, color: tuple[int, int, int], thickness: float) -> Any:
        return self._scene3d.add_line_segments(
            name, points, color, thickness=thickness, thickness_units="world", visible=bool(points.any())
        )

    def _arrow(self, name: str, color: tuple[int, int, int]) -> Any:
        shape = {"shaft_radius": 8e-4, "head_radius": 2e-3, "head_length": 4e-3}
        return self._scene3d.add_arrows(
            f"{self._root}/{name}",
            np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 0.01]]]),
            color,
            visible=False,
            **shape,
        )

    def remove(self) -> None:
        """Take it, with all that belongs to it, out of the picture."""
        self._base.remove()

    def show(self, state: ArmState, options: ViewOptions) -> None:
        """Show the arm as it is known now."""
        place(self._base, state.T_world_base)
        pose = state.newest("pose")
        self._tip.visible = pose is not None
        if pose is None:
            return
        T = pose["T_base_sensor"]
        place(self._tip, T)
        self._show_links(state)
        self._show_path(state, options)
        self._show_ahead(state, T[:3, 3], options)
        self._show_contact(state, options)
        self._show_truth(state, options)
        command = state.newest("command")
        way = np.zeros(3) if command is None else T[:3, :3] @ command["twist"][:3] * TWIST_SECONDS
        _point(self._twist, T[:3, 3], way, options.twist)

    def _show_links(self, state: ArmState) -> None:
        chain = None if self._arm is None else self._arm.kinematics
        known = chain is not None and state.joints is not None and len(state.joints) == len(chain.names)
        self._links.visible = known and self._meshes is None
        if chain is not None and state.joints is not None and known:
            if self._meshes is not None:
                self._meshes.show(chain.names, state.joints)
            else:
                self._links.points = chain.capsules(state.joints).ends

    def _show_path(self, state: ArmState, options: ViewOptions) -> None:
        self._path.visible = options.path and len(state.path) > 1
        if self._path.visible:
            points = np.array(state.path)
            self._path.points = np.stack([points[:-1], points[1:]], axis=1)

    def _show_ahead(self, state: ArmState, tip: Array, options: ViewOptions) -> None:
        """Where the task leads, and its goal."""
        self._ahead.visible = self._goal.visible = bool(options.path and len(state.ahead))
        if self._ahead.visible:
            points = way_ahead(tip, state.ahead)
            self._ahead.points = np.stack([points[:-1], points[1:]], axis=1)
            self._goal.position = tuple(points[-1].tolist())

    def _show_contact(self, state: ArmState, options: ViewOptions) -> None:
        """The believed feature frame where the sensor was at its exposure, if there is contact."""
        belief, presence = state.newest("belief"), state.newest("presence")
        T = None if belief is None else pose_at(state, belief["stamp_ns"])
        there = T is not None and bool(presence is None or presence["in_contact"])
        for node in (self._contact, self._ellipsoid, self._normals):
            node.visible = there
        command = state.newest("command")
        reference = None if command is None else command["reference"]
        self._reference.visible = bool(there and reference is not None and np.isfinite(reference).all())
        if not there or belief is None or T is None:
            self._shear.visible = False
            return
        T_base_f = T @ belief["mean"]
        place(self._contact, T_base_f)
        cov = ros_from_left(belief["cov"], belief["mean"][:3, 3])
        sizes, axes = np.linalg.eigh(cov[:3, :3])
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        radii = 2.0 * options.uncertainty * np.sqrt(np.maximum(sizes, 0.0))
        place(self._ellipsoid, T @ se3_of(axes, belief["mean"][:3, 3]))
        self._ellipsoid.scale = tuple(np.maximum(radii, 1e-5).tolist())
        self._normals.points = cone(belief["mean"], cov, options.uncertainty)
        X_fs = se3.inverse(belief["mean"])
        shear = T_base_f[:3, :2] @ X_fs[:2, 3] * SHEAR_SCALE
        _point(self._shear, T_base_f[:3, 3], shear, True)
        limit = largest_shear(self._skin, X_fs[2, 3]) if self._skin is not None and options.friction else None
        self._friction.visible = limit is not None
        if limit is not None:
            rim = limit * SHEAR_SCALE * np.stack([np.cos(ROUND), np.sin(ROUND), 0.0 * ROUND], axis=1)
            self._friction.points = np.stack([rim[:-1], rim[1:]], axis=1)
        if self._reference.visible and reference is not None:
            place(self._reference, T_base_f @ se3.pose_from_euler(reference))

    def _show_truth(self, state: ArmState, options: ViewOptions) -> None:
        truth = state.newest("truth")
        T = None if truth is None else pose_at(state, truth["stamp_ns"])
        self._truth.visible = bool(
            options.truth and truth is not None and T is not None and truth["in_contact"]
        )
        if self._truth.visible and truth is not None and T is not None:
            place(self._truth, T @ se3.inverse(truth["T_fs"]))


def pose_at(state: ArmState, stamp_ns: int) -> Array | None:
    """T_base_sensor (4, 4) of the last pose at or before a stamp, or the first after it."""
    found = None
    for row in reversed(state.streams["pose"]):
        found = row["T_base_sensor"]
        if row["stamp_ns"] <= stamp_ns:
            break
    return found


def _point(arrow: Any, start: Array, way: Array, wanted: bool) -> None:
    """Have an arrow lead from a point (3,) along a way (3,)."""
    arrow.visible = wanted and se3.norm(way) > LEAST_ARROW
    if arrow.visible:
        arrow.points = np.array([[start, start + way]])
