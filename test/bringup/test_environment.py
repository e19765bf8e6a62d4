"""Nodes run in a ROS domain of their own, on this host only, unless the user says otherwise."""

import socket
from pathlib import Path

import pytest

from tactile_bringup.launching.environment import DOMAINS, free_domain_id, ros_environment


def test_a_domain_is_chosen_and_discovery_stays_on_this_host():
    environment = ros_environment(Path("logs"), {"PATH": "/bin"})
    assert environment.domain_chosen and environment.domain_id in DOMAINS
    assert environment.variables["ROS_DOMAIN_ID"] == str(environment.domain_id)
    assert environment.discovery_range == "LOCALHOST"
    assert environment.variables["PATH"] == "/bin"
    assert environment.variables["PYTHONSAFEPATH"] == "1"


def test_what_the_user_has_set_is_kept():
    given = {"ROS_DOMAIN_ID": "7", "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "OMP_NUM_THREADS": "2"}
    environment = ros_environment(Path("logs"), given)
    assert (environment.domain_id, environment.domain_chosen, environment.discovery_range) == (
        7,
        False,
        "SUBNET",
    )
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
