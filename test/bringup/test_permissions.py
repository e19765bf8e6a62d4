"""`tactile security`: who may say and hear what, in the layouts of sros2 and of DDS security."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

from tactile_bringup.cli import main

NODES = ("estimator", "filter", "controller", "marker_view")


def rights(folder: Path, right: str) -> dict[str, set[str]]:
    """By enclave, the DDS topics that its permissions let it publish, or subscribe to."""
    found = {}
    for file in (folder / "enclaves").rglob("permissions.xml"):
        (grant,) = ElementTree.parse(file).getroot().iter("grant")
        assert (
            grant.findtext("default") == "DENY"
            and grant.findtext("subject_name") == f"CN={grant.get('name')}"
        )
        assert file.parent == folder / "enclaves" / str(grant.get("name")).strip("/")
        found[str(grant.get("name"))] = {
            e.text or "" for e in grant.findall(f"allow_rule/{right}/topics/topic")
        }
    return found


def holders(folder: Path, right: str, topic: str) -> set[str]:
    return {enclave for enclave, allowed in rights(folder, right).items() if topic in allowed}


@pytest.fixture(scope="module")
def pushing(tmp_path_factory) -> Path:
    """Of a task of two arms."""
    folder = tmp_path_factory.mktemp("security") / "dual"
    assert main(["security", str(folder), "dual_pushing", "--domain", "42"]) == 0
    return folder


def test_each_process_and_who_stops_and_starts_by_hand_has_an_enclave(pushing):
    arms = ElementTree.parse(pushing / "policies.xml").getroot().iter("enclave")
    named = {enclave.get("path") for enclave in arms}
    nodes = {f"/{arm}/{name}" for arm in ("leader", "follower") for name in NODES}
    plain = {"/tactile_launch", "/operator", "/tactile_view", "/tactile_foxglove"}
    assert named == nodes | {"/sim", "/object", "/recorder"} | plain
    assert set(rights(pushing, "publish")) == named


def test_what_moves_and_stops_an_arm_is_for_those_alone_whose_part_it_is(pushing):
    assert holders(pushing, "publish", "rt/leader/command/request") == {"/leader/controller"}
    assert holders(pushing, "publish", "rt/estop") == {"/operator", "/tactile_launch"}
    assert holders(pushing, "publish", "rq/leader/arm/resetRequest") == {"/operator"}
    goals = holders(pushing, "publish", "rq/leader/run_task/_action/send_goalRequest")
    assert goals == {"/operator", "/tactile_launch"}
    assert holders(pushing, "publish", "rq/leader/controller/set_parametersRequest") == {"/operator"}
    assert holders(pushing, "publish", "rt/leader/contact/state") == {"/leader/filter"}
    assert holders(pushing, "publish", "rt/leader/tactile/image") == {"/sim"}
    assert holders(pushing, "subscribe", "rt/estop") >= {"/sim", "/recorder"}
    for looker in ("/tactile_view", "/tactile_foxglove"):
        written = rights(pushing, "publish")[looker] - {"ros_discovery_info", "rt/parameter_events"}
        assert all(name == f"rr{looker}/{name.rpartition('/')[2]}" for name in written), "it sends nothing"
    everything = set().union(*rights(pushing, "publish").values())
    assert not any("*" in name or "?" in name for name in everything)


def test_permissions_hold_in_the_domain_that_was_named_and_nobody_without_keys_takes_part(pushing):
    for file in pushing.rglob("*.xml"):
        assert {e.text for e in ElementTree.parse(file).getroot().iter("id")} <= {"42"}
    rules = ElementTree.parse(pushing / "governance.xml").getroot()
    assert {e.text for e in rules.iter("id")} == {"42"}
    for name, value in (
        ("allow_unauthenticated_participants", "false"),
        ("enable_join_access_control", "true"),
        ("enable_read_access_control", "true"),
        ("enable_write_access_control", "true"),
    ):
        assert [e.text for e in rules.iter(name)] == [value]


def test_a_camera_and_an_arm_of_somebody_else_are_named_as_left_out(tmp_path, capsys):
    scene = tmp_path / "cell.yaml"
    scene.write_text("""\
arms:
  arm:
    driver: external
    start: {position: [0.0, 0.0, 0.032]}
    sensor: {camera: external, camera_rate: 60.0}
""")
    folder = tmp_path / "out"
    assert main(["security", str(folder), "surface_following", "--scene", str(scene)]) == 0
    said = capsys.readouterr().out
    assert "not in it: the nodes that move /arm" in said and "publishes the images of /arm" in said
    assert holders(folder, "publish", "rt/arm/command/twist") == {"/arm/arm"}


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["surface_following", "--domain", "233"], "ROS domain '233': must be a number from 0 to 232"),
        (["surface_following", "--scene", "nowhere"], "scene: unknown name 'nowhere'"),
        (["nothing"], "task: unknown name 'nothing'"),
    ],
)
def test_wrong_input_is_refused_and_nothing_written(tmp_path, capsys, words, complaint):
    assert main(["security", str(tmp_path / "new"), *words]) == 2
    assert complaint in " ".join(capsys.readouterr().err.split()) and not (tmp_path / "new").exists()


def test_a_folder_with_something_in_it_is_left_as_it_is(tmp_path, capsys):
    (tmp_path / "keys").write_text("precious")
    assert main(["security", str(tmp_path), "surface_following"]) == 2
    assert "is not empty" in " ".join(capsys.readouterr().err.split())
    assert [path.name for path in tmp_path.iterdir()] == ["keys"]
