"""An arm as its URDF draws it, each mesh where its link is; where one cannot be shown, links and a remark."""

import dataclasses
import io
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import viser
from cell_messages import messages
from scipy.spatial.transform import Rotation

from tactile_bringup.launching.page_process import free_port
from tactile_scene.kinematics.arm_file import load_arm
from tactile_scene.scene_file import load_scene
from tactile_view.cell_state import CellState
from tactile_view.cell_view import CellView
from tactile_view.urdf_meshes import UrdfMeshes, mesh_path

URDF = """
<robot name="two_joints">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="world_link"/>
  <joint name="stand" type="fixed">
    <parent link="world_link"/><child link="base"/><origin xyz="0 0 0.5" rpy="0 0 1.2"/>
  </joint>
  <link name="base"><visual><geometry><cylinder radius="0.05" length="0.1"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="column"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
  <link name="column"><visual><origin xyz="0 0 0.1"/>
    <geometry><mesh filename="MESH" scale="0.001 0.001 0.002"/></geometry><material name="red"/>
  </visual></link>
  <joint name="nod" type="revolute"><parent link="column"/><child link="beam"/>
    <origin xyz="0 0.02 0.2" rpy="0.3 0 0"/><axis xyz="0 1 1"/>
    <limit lower="-3" upper="3" velocity="1" effort="1"/></joint>
  <link name="beam"><visual><geometry><box size="0.3 0.04 0.04"/></geometry></visual></link>
  <joint name="end" type="fixed"><parent link="beam"/><child link="flange"/><origin xyz="0.3 0 0"/></joint>
  <link name="flange"><visual><geometry><sphere radius="0.02"/></geometry></visual></link>
</robot>
"""
ARM = "urdf: arm.urdf\nbase: base\nflange: flange\nacceleration: [1, 1]\nready_deg: [0, 0]\ncapsules: {}\n"
BRICK = trimesh.creation.box((100.0, 60.0, 50.0))  # mm
Q = np.array([0.7, -0.4])


@pytest.fixture
def server():
    server = viser.ViserServer(host="127.0.0.1", port=free_port("127.0.0.1"), verbose=False)
    yield server
    server.stop()


def arm_in(folder: Path, mesh: str = "brick.stl", urdf: str = URDF):
    """The chain of the URDF, with a mesh beside it."""
    BRICK.export(folder / "brick.stl")
    (folder / "arm.urdf").write_text(urdf.replace("MESH", mesh))
    (folder / "arm.yaml").write_text(ARM)
    return load_arm(folder / "arm.yaml")


def nodes(server) -> dict:
    """The nodes of the scene, which viser finds by name only for itself."""
    return {name: each for name, each in server.scene._handle_from_node_name.items() if "/urdf" in name}


def pose_of(server, name: str) -> np.ndarray:
    """Pose (4, 4) of a node below /arms/arm."""
    T, found = np.eye(4), nodes(server)
    parts = name.split("/")
    for end in range(4, len(parts) + 1):
        node, step = found["/".join(parts[:end])], np.eye(4)
        step[:3, :3] = Rotation.from_quat(np.roll(node.wxyz, -1)).as_matrix()
        step[:3, 3] = node.position
        T = T @ step
    return T


def drawn(server) -> list[str]:
    """Names of the meshes, in the order of the URDF."""
    return sorted(
        (name for name in nodes(server) if "visual" in name), key=lambda name: int(name.split("visual")[1])
    )


def test_what_is_drawn_is_where_its_link_is(server, tmp_path):
    chain = arm_in(tmp_path)
    meshes = UrdfMeshes(server.scene, "/arms/arm", chain.description, (90, 96, 104))
    base, column, beam, flange = drawn(server)
    for q in (np.zeros(2), Q):
        meshes.show(chain.names, q)
        np.testing.assert_allclose(pose_of(server, flange), chain.pose(q), atol=1e-9)
        np.testing.assert_allclose(pose_of(server, base), np.eye(4), atol=1e-9)
        turned = Rotation.from_euler("z", q[0]).as_matrix()
        np.testing.assert_allclose(pose_of(server, column)[:3, :3], turned, atol=1e-9)
        np.testing.assert_allclose(pose_of(server, column)[:3, 3], [0.0, 0.0, 0.2], atol=1e-9)
        np.testing.assert_allclose(np.linalg.inv(pose_of(server, beam)) @ chain.pose(q), move(0.3), atol=1e-9)


def move(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def test_meshes_have_the_scale_and_the_color_that_the_urdf_says(server, tmp_path):
    UrdfMeshes(server.scene, "/arms/arm", arm_in(tmp_path).description, (90, 96, 104))
    column = trimesh.load_scene(io.BytesIO(nodes(server)[drawn(server)[1]].glb_data), file_type="glb")
    np.testing.assert_allclose(column.extents, [0.1, 0.06, 0.1], rtol=1e-6)
    colors = column.to_geometry().visual.vertex_colors
    np.testing.assert_array_equal(np.unique(colors, axis=0), [[255, 0, 0, 255]])


def test_a_package_is_one_of_ros_or_a_folder_above(tmp_path, monkeypatch):
    sourced, described = tmp_path / "ros/share/their_arm", tmp_path / "src/our_arm"
    for folder in (sourced, described):
        (folder / "meshes").mkdir(parents=True)
        (folder / "meshes/a.stl").touch()
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"{tmp_path}/none:{tmp_path}/ros")
    urdf = described / "urdf/arm.urdf"
    assert mesh_path(urdf, "package://their_arm/meshes/a.stl") == sourced / "meshes/a.stl"
    assert mesh_path(urdf, "package://our_arm/meshes/a.stl") == described / "meshes/a.stl"
    assert mesh_path(urdf, "file:///opt/a.stl") == Path("/opt/a.stl")
    assert mesh_path(urdf, "../meshes/a.stl").resolve() == described / "meshes/a.stl"


FAULTS = {
    "none.stl": "No such file or directory: '.*none.stl'",
    "package://no_arm/a.stl": "package://no_arm/a.stl is nowhere: .* in a folder 'no_arm' above that file",
    "arm.yaml": "arm.yaml: is no mesh that can be read: ",
    "cut.stl": "cut.stl: is no mesh that can be read: ",
    "brick.dae": r"brick.dae: .*collada.*; 'tactile_servoing\[view\]' brings it",
}


@pytest.mark.parametrize("mesh", FAULTS)
def test_where_a_mesh_cannot_be_shown_links_are_and_it_is_said(server, tmp_path, monkeypatch, mesh):
    chain = arm_in(tmp_path, mesh)
    (tmp_path / "cut.stl").write_bytes((tmp_path / "brick.stl").read_bytes()[:200])
    (tmp_path / "brick.dae").write_text("<COLLADA/>")
    monkeypatch.setitem(sys.modules, "collada", None)
    state = CellState()
    for message in messages(0.1):
        state.take(*message)
    state.arms["arm"].joints = Q
    scene = load_scene("plane")
    arm = dataclasses.replace(scene.arms["arm"], kinematics=chain)
    view = CellView(server, dataclasses.replace(scene, arms={"arm": arm}))
    view.show(state)
    assert not nodes(server), "nor half of an arm"
    assert server.scene._handle_from_node_name["/arms/arm/links"].visible
    assert re.search(f"its meshes are not shown: .*{FAULTS[mesh]}", view.remarks["arm"])


def test_a_franka_by_its_makers_urdf_stands_as_its_kinematics_say(server, tmp_path):
    """Collision meshes in the place of large ones, but for a finger, which is in COLLADA."""
    franky_sim = pytest.importorskip("franky_sim", reason="needs the URDF in franky-sim (extra franka-sim)")
    assets = Path(franky_sim.__file__).parent / "assets"
    shutil.copytree(
        assets / "meshes", tmp_path / "meshes", ignore=shutil.ignore_patterns("*.obj", "link*.dae")
    )
    text = (assets / "fr3.urdf").read_text()
    text = re.sub(r"meshes/(link\d|hand)_vis.dae", r"meshes/\1_coll.stl", text)
    (tmp_path / "arm.urdf").write_text(text)
    file = ARM.replace("flange: flange", "flange: fr3_link8").replace("[1, 1]", str([1] * 7))
    (tmp_path / "arm.yaml").write_text(file.replace("[0, 0]", "[0, 0, 0, -90, 0, 90, 0]"))
    chain, known = load_arm(tmp_path / "arm.yaml"), load_arm("fr3")
    meshes = UrdfMeshes(server.scene, "/arms/arm", chain.description, (90, 96, 104))
    q = np.array([0.3, -0.5, 0.2, -1.8, 0.4, 1.6, -0.7])
    meshes.show(chain.names, q)
    names = drawn(server)
    assert len(names) == text.count("</visual>")
    T_flange_hand = np.eye(4)
    T_flange_hand[:3, :3] = Rotation.from_euler("z", -45.0, degrees=True).as_matrix()
    np.testing.assert_allclose(pose_of(server, names[8]), known.pose(q) @ T_flange_hand, atol=1e-9)
