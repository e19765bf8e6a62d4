"""Nodes run in a ROS domain of their own, on this host only, unless the user says otherwise."""

import os
import socket
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tactile_base.config_paths import config_path
from tactile_bringup.launching.environment import DOMAINS, free_domain_id, ros_environment
from tactile_ros.discovery import PROFILE_VARIABLES, use_dds_profile

DDS = "{http://www.eprosima.com}"


def test_a_domain_is_chosen_and_discovery_stays_on_this_host():
    environment = ros_environment(Path("logs"), {"PATH": "/bin"})
    assert environment.domain_chosen and environment.domain_id in DOMAINS
    assert environment.variables["ROS_DOMAIN_ID"] == str(environment.domain_id)
    assert environment.discovery == "LOCALHOST"
    assert environment.variables["PATH"] == "/bin"
    assert environment.variables["PYTHONSAFEPATH"] == "1"


def test_what_the_user_has_set_is_kept():
    given = {"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "OMP_NUM_THREADS": "2"}
    environment = ros_environment(Path("logs"), given)
    assert (environment.domain_id, environment.domain_chosen) == (7, False)
    assert environment.variables["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SUBNET"
    assert environment.variables["OMP_NUM_THREADS"] == "2"


@pytest.mark.parametrize("text", ["red", "-1", "233"])
def test_a_domain_that_is_none_is_refused(text):
    with pytest.raises(ValueError, match=f"ROS_DOMAIN_ID = '{text}': must be a number from 0 to 232"):
        ros_environment(Path("logs"), {"ROS_DOMAIN_ID": text})


@pytest.mark.parametrize("number", [0, 1, 9])
def test_a_domain_in_use_by_whichever_participant_is_passed_over(number):
    domain = free_domain_id(start=40)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * domain + 10 + 2 * number))
        assert free_domain_id(start=DOMAINS.index(domain)) != domain


def test_a_domain_counts_as_shared_while_somebody_may_be_in_it():
    domain = str(free_domain_id(start=70))
    assert not ros_environment(Path("logs"), {}).shared
    assert not ros_environment(Path("logs"), {"ROS_DOMAIN_ID": domain}).shared
    everywhere = {"ROS_DOMAIN_ID": domain, "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    assert ros_environment(Path("logs"), everywhere).shared
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * int(domain) + 10))
        assert ros_environment(Path("logs"), {"ROS_DOMAIN_ID": domain}).shared


@pytest.mark.parametrize(
    "given",
    [
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SYSTEM_DEFAULT"},
        {"ROS_STATIC_PEERS": "10.0.0.5"},
        {"ROS_DISCOVERY_SERVER": "10.0.0.5:11811"},
        {"FASTDDS_DEFAULT_PROFILES_FILE": "/home/me/mine.xml"},
    ],
)
def test_what_lets_other_hosts_in_is_said(given):
    (name, value), *_ = given.items()
    environment = ros_environment(Path("logs"), given)
    assert environment.discovery.endswith(f"open to other hosts by {name}={value}")
    assert not environment.shared
    assert ros_environment(Path("logs"), {**given, "ROS_DOMAIN_ID": "99"}).shared


def test_the_profile_of_a_process_that_started_ours_is_no_wish_of_the_user():
    inherited = {"FASTDDS_DEFAULT_PROFILES_FILE": str(config_path("dds/all_hosts.xml"))}
    assert ros_environment(Path("logs"), inherited).discovery == "LOCALHOST"


def test_a_configuration_folder_without_profiles_confines_nodes_as_well(monkeypatch, tmp_path):
    monkeypatch.setenv("TACTILE_CONFIG_DIR", str(tmp_path))
    for name in (*PROFILE_VARIABLES, "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"):
        monkeypatch.setenv(name, "")
    use_dds_profile()
    profile = Path(os.environ[PROFILE_VARIABLES[0]])
    assert profile.name == "this_host.xml" and profile.is_file()
    assert os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"


def test_the_two_profiles_differ_in_nothing_but_whom_they_let_in():
    here, everywhere = (
        ElementTree.parse(config_path(f"dds/{n}.xml")).getroot() for n in ("this_host", "all_hosts")
    )
    (udp,) = [d for d in here.iter(f"{DDS}transport_descriptor") if d.find(f"{DDS}interfaces") is not None]
    assert [i.get("name") for i in udp.iter(f"{DDS}interface")] == ["127.0.0.1"]
    udp.remove(udp.find(f"{DDS}interfaces"))
    assert text_of(here) == text_of(everywhere)


def text_of(root: ElementTree.Element) -> list[tuple[str, str]]:
    return [(element.tag, (element.text or "").strip()) for element in root.iter()]
