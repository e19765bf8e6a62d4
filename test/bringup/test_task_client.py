"""The launcher's client asks on until it knows that the nodes are active, and hears whether an arm rests."""

import math

import pytest
from lifecycle_msgs.msg import State
from lifecycle_msgs.srv import GetState
from rclpy.task import Future

from tactile_bringup.launching.task_client import ANSWER_TIME, ArmTask, Progress, TaskClient
from tactile_msgs.msg import ArmStatus


class Service:
    """A state service that answers nothing until `answers` is set."""

    def __init__(self) -> None:
        self.answers = False
        self.pending: list[Future] = []
        self.asked = 0

    def service_is_ready(self) -> bool:
        return True

    def call_async(self, request: GetState.Request) -> Future:
        self.asked += 1
        future = Future()
        if self.answers:
            state = State(id=State.PRIMARY_STATE_ACTIVE, label="active")
            future.set_result(GetState.Response(current_state=state))
        else:
            self.pending.append(future)
        return future

    def remove_pending_request(self, future: Future) -> None:
        self.pending.remove(future)


class Graph:
    """Stands for the ROS node of the client."""

    def __init__(self, service: Service) -> None:
        self.service = service

    def create_client(self, kind: type, name: str) -> Service:
        assert name == "/arm/filter/get_state"
        return self.service


@pytest.fixture
def service() -> Service:
    return Service()


@pytest.fixture
def client(service: Service) -> TaskClient:
    made = TaskClient.__new__(TaskClient)  # without a participant of DDS
    made._node, made._states = Graph(service), {}
    return made


def test_a_question_whose_answer_was_lost_is_asked_again(client, service):
    assert client.inactive(["/arm/filter"], 0.0) == {"/arm/filter": "not there yet"}
    service.answers = True
    client.inactive(["/arm/filter"], 0.5 * ANSWER_TIME)
    assert service.asked == 1
    client.inactive(["/arm/filter"], 1.5 * ANSWER_TIME)
    assert service.asked == 2 and not service.pending
    assert client.inactive(["/arm/filter"], 1.6 * ANSWER_TIME) == {}


def test_an_active_node_is_not_asked_again(client, service):
    service.answers = True
    client.inactive(["/arm/filter"], 0.0)
    assert client.inactive(["/arm/filter"], 1.0) == {}
    client.inactive(["/arm/filter"], 100.0)
    assert service.asked == 1


def test_a_node_that_was_active_is_asked_anew_on_demand_and_another_is_not(client, service):
    assert not client.ask_again("/arm/filter")
    service.answers = True
    client.inactive(["/arm/filter"], 0.0)
    client.inactive(["/arm/filter"], 1.0)
    service.answers = False
    assert client.ask_again("/arm/filter")
    assert "/arm/filter" in client.inactive(["/arm/filter"], 2.0)
    service.answers = True
    client.inactive(["/arm/filter"], 2.0 + 2 * ANSWER_TIME)
    assert client.inactive(["/arm/filter"], 2.0 + 3 * ANSWER_TIME) == {}


@pytest.mark.parametrize(
    ("mode", "speed", "rests"),
    [
        (ArmStatus.RESTING, 0.0, True),
        (ArmStatus.MOVING, 0.0, False),  # it may go on at once
        (ArmStatus.STOPPING, 0.0, False),
        (ArmStatus.ESTOP, 0.0, True),
        (ArmStatus.ESTOP, 4e-4, True),  # speeds that are measured are not zero
        (ArmStatus.ESTOP, 0.002, False),
        (ArmStatus.FAULT, 0.0, True),
        (ArmStatus.FAULT, -0.01, False),
        (ArmStatus.FAULT, math.nan, False),  # nobody knows
    ],
)
def test_an_arm_that_was_stopped_by_safety_rests_where_its_twist_is_zero(mode, speed, rests):
    task = ArmTask.__new__(ArmTask)  # without a participant of DDS
    task.progress, task._regular_s = Progress(), math.inf
    task._heard_s = task._moved_s = -math.inf
    task._on_arm(ArmStatus(mode=ArmStatus.MOVING, twist=[0.01] + [0.0] * 5))
    for _ in range(2):
        task._on_arm(ArmStatus(mode=mode, twist=[0.0, speed] + [0.0] * 4))
    assert (task.rests_for() > 0.0) == rests
