"""What all nodes share: how they start, report, fail and end."""

import os
import signal
import textwrap

import pytest
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.msg import Parameter as ParameterMsg
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter, get_parameter_value
from sensor_msgs.msg import Image
from std_msgs.msg import Int64

from tactile_ros import qos
from tactile_ros.conversions import ns_from_time

TOY = textwrap.dedent("""
    import sys
    from dataclasses import dataclass
    from sensor_msgs.msg import Image
    from std_msgs.msg import Int64
    from tactile_ros.run_nodes import run
    from tactile_ros.managed_node import ConfigurationError, ManagedNode
    from tactile_ros.parameters import SettingsParameters
    from tactile_ros.qos import IMAGE, STATE
    from tactile_base.settings import Settings, setting

    @dataclass(frozen=True)
    class ToySettings(Settings):
        fail_in: str = setting("nothing", doc="where to fail")
        gain: float = setting(1.0, lower=0.0, upper=10.0, unit="1/s", doc="a gain")

    class Toy(ManagedNode):
        def __init__(self):
            super().__init__("toy")
            self.settings = SettingsParameters(self, ToySettings())

        def configure(self):
            self.fail("configure")
            self.out = self.publisher(Int64, "doubled", STATE)
            self.subscribe(Int64, "number", self.double, STATE, age_limit=0.2)
            self.subscribe(Image, "image", lambda image: None, IMAGE)

        def activate(self):
            self.fail("activate")

        def deactivate(self):
            print("deactivated", flush=True)

        def cleanup(self):
            self.fail("clean up")
            print("cleaned up", flush=True)

        def double(self, message):
            self.fail("callback")
            self.count("numbers")
            self.out.publish(Int64(data=2 * message.data))

        def fail(self, where):
            if self.settings.value.fail_in == where:
                raise ZeroDivisionError("in double") if where == "callback" else ConfigurationError("as told")

    sys.exit(run(Toy))
""")


@pytest.fixture(scope="module")
def running(shared_graph):
    """A node for all tests that leave it as it was."""
    shared_graph.start_code("toy", TOY)
    return shared_graph


@pytest.fixture
def toy(running):
    running.restart("toy")
    assert running.set_parameter("toy", "gain", 1.0).successful
    return running


def change(graph, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return graph.call(ChangeState, "toy/change_state", request).success


def state(graph) -> str:
    return graph.call(GetState, "toy/get_state", GetState.Request()).current_state.label


def test_a_node_starts_by_itself_reports_each_second_and_ends_cleanly_by_sigterm(graph):
    process = graph.start_code("toy", TOY, {"diagnostics_period": 1.0})
    numbers = graph.publisher(Int64, "number")
    doubled = graph.collect(Int64, "doubled")
    numbers.publish(Int64(data=21))
    assert graph.wait(lambda: bool(doubled)) and doubled[0].data == 42
    report = graph.wait_for_count("toy", "numbers")
    assert report.values["state"] == "active" and report.values["number messages"] == report.values["numbers"]
    silent = "number: no message for"
    assert graph.wait(lambda: any(silent in report.message for report in graph.reports("toy")))
    since = len(graph.diagnostics)  # the news of it came between two
    assert graph.wait(lambda: len(graph.diagnostics) >= since + 4)
    first, last = (ns_from_time(graph.diagnostics[since + k].header.stamp) for k in (0, 3))
    assert (last - first) * 1e-9 == pytest.approx(3.0, abs=0.9)
    process.terminate()
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 0
    log = graph.log("toy").read_text()
    assert log.index("deactivated") < log.index("cleaned up") and "SIGTERM" in log


def test_silence_of_an_input_is_told_with_age_and_limit(toy):
    numbers = toy.publisher(Int64, "number")
    numbers.publish(Int64(data=1))

    def told(report) -> bool:
        return "number: no message for" in report.message and "(limit 0.20 s)" in report.message

    toy.wait_for_report("toy", told)


@pytest.mark.parametrize("where", ["configure", "activate"])
def test_a_node_that_cannot_start_ends_with_exit_code_1_and_says_why(graph, where):
    process = graph.start_code("toy", TOY, {"fail_in": where}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    log = graph.log("toy").read_text()
    assert f"cannot {where}: as told" in log and "Traceback" not in log and "cleaned up" in log


def test_an_error_in_a_callback_ends_the_node_after_deactivating_with_exit_code_1_and_the_traceback(graph):
    process = graph.start_code("toy", TOY, {"fail_in": "callback"})
    graph.publisher(Int64, "number").publish(Int64(data=1))
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    log = graph.log("toy").read_text()
    assert "ZeroDivisionError: in double" in log and "deactivated" in log and "cleaned up" in log


def test_a_node_that_cannot_clean_up_ends_with_exit_code_1_and_says_why(graph):
    process = graph.start_code("toy", TOY, {"fail_in": "clean up"})
    process.send_signal(signal.SIGTERM)
    assert graph.wait(lambda: process.poll() is not None) and process.returncode == 1
    log = graph.log("toy").read_text()
    assert "cannot clean up: as told" in log and "deactivated" in log and "Traceback" not in log


def test_a_lifecycle_manager_takes_a_node_through_its_states_and_an_inactive_one_ignores_messages(graph):
    graph.start_code("toy", TOY, {"autostart": False}, wait=False)
    doubled = graph.collect(Int64, "doubled")
    assert state(graph) == "unconfigured"
    assert change(graph, Transition.TRANSITION_CONFIGURE) and state(graph) == "inactive"
    numbers = graph.publisher(Int64, "number")
    numbers.publish(Int64(data=1))
    graph.wait_for_count("toy", "number messages")
    assert not doubled
    assert change(graph, Transition.TRANSITION_ACTIVATE) and state(graph) == "active"
    numbers.publish(Int64(data=2))
    assert graph.wait(lambda: [m.data for m in doubled] == [4])
    assert change(graph, Transition.TRANSITION_DEACTIVATE)
    assert change(graph, Transition.TRANSITION_CLEANUP) and state(graph) == "unconfigured"
    assert change(graph, Transition.TRANSITION_CONFIGURE) and change(graph, Transition.TRANSITION_ACTIVATE)
    numbers = graph.publisher(Int64, "number")
    numbers.publish(Int64(data=3))
    assert graph.wait(lambda: [m.data for m in doubled] == [4, 6])


def test_a_failed_configuration_can_be_mended_by_a_parameter_and_tried_again(graph):
    graph.start_code("toy", TOY, {"autostart": False, "fail_in": "configure"}, wait=False)
    assert not change(graph, Transition.TRANSITION_CONFIGURE) and state(graph) == "unconfigured"
    assert graph.set_parameter("toy", "fail_in", "nothing").successful
    assert change(graph, Transition.TRANSITION_CONFIGURE) and state(graph) == "inactive"


def test_two_nodes_of_one_name_are_told_by_both_until_one_ends(graph):
    graph.start_code("toy", TOY)
    twin = "another node in this ROS domain is called /arm/toy, too: end one of them"
    assert not [report for report in graph.reports("toy") if twin in report.message]
    graph.start_code("twin", TOY, wait=False)
    graph.wait_until_active("twin")
    for name in ("toy", "twin"):
        assert graph.wait(lambda name=name: twin in graph.log(name).read_text()), name
    graph.wait_for_report("toy", lambda report: twin in report.message)
    graph.stop("twin")
    graph.diagnostics.clear()
    graph.wait_for_report("toy", lambda report: twin not in report.message)


def test_a_misspelt_parameter_is_told_with_the_nearest_name(graph):
    graph.start_code("toy", TOY, {"gian": 3.0})
    assert "unknown name 'gian' (did you mean 'gain'?)" in graph.log("toy").read_text()


def test_a_parameter_of_the_wrong_type_at_start_ends_the_process_and_names_the_type(graph):
    process = graph.start_code("toy", TOY, {"gain": "high"}, wait=False)
    assert graph.wait(lambda: process.poll() is not None)
    assert process.returncode == 1
    log = graph.log("toy").read_text()
    assert "parameter gain: must be of type DOUBLE" in log and "Traceback" not in log


@pytest.mark.parametrize("service", [SetParameters, SetParametersAtomically], ids=lambda kind: kind.__name__)
def test_a_parameter_of_a_type_that_is_none_is_refused_and_the_node_goes_on(toy, service):
    sound, unknown = (Parameter("gain", value=2.0).to_parameter_msg() for _ in range(2))
    unknown.value.type = 192
    name = {SetParameters: "set_parameters", SetParametersAtomically: "set_parameters_atomically"}[service]
    answer = toy.call(service, f"toy/{name}", service.Request(parameters=[sound, unknown]))
    results = answer.results if service is SetParameters else [answer.result]
    assert [each.successful for each in results] == [False] * len(results)
    assert "gain is of type 192" in results[0].reason
    assert toy.get_parameter("toy", "gain") == 1.0
    assert toy.set_parameter("toy", "gain", 2.0).successful


def test_what_is_dumped_is_taken_as_it_is_and_nothing_else_of_what_is_read_only(toy):
    """`ros2 param load` sets each parameter of a dump again, of the type that its text looks like."""
    names = toy.call(ListParameters, "toy/list_parameters", ListParameters.Request()).result.names
    values = {name: toy.get_parameter("toy", name) for name in names}
    request = SetParameters.Request()
    for name, value in values.items():
        plain = value if isinstance(value, bool | int | float | str) else list(value)
        request.parameters.append(ParameterMsg(name=name, value=get_parameter_value(str(plain))))
    results = toy.call(SetParameters, "toy/set_parameters", request).results
    assert [each.reason for each in results if not each.successful] == [] and len(results) > 10
    assert {name: toy.get_parameter("toy", name) for name in names} == values
    assert not toy.set_parameter("toy", "priority", 1).successful
    assert toy.set_parameter("toy", "gain", "1e-05").successful
    assert toy.get_parameter("toy", "gain") == 1e-5


@pytest.mark.parametrize("transition", [{"id": 200}, {"id": 3}, {"label": "fly"}], ids=str)
def test_a_transition_that_cannot_be_is_refused_and_the_node_goes_on(toy, transition):
    request = ChangeState.Request(transition=Transition(**transition))
    assert not toy.call(ChangeState, "toy/change_state", request).success
    assert state(toy) == "active"


def test_a_node_that_was_held_up_beside_images_hears_of_the_rest_soon(graph):
    toy = graph.start_code("toy", TOY)
    doubled = graph.collect(Int64, "doubled")
    numbers = graph.publisher(Int64, "number", qos.writer_profile(qos.STATE))
    images = graph.publisher(Image, "image", qos.IMAGE)
    picture = Image(height=480, width=640, step=640, encoding="mono8", data=bytes(480 * 640))
    sent = 0

    def send() -> None:
        nonlocal sent
        sent += 1
        numbers.publish(Int64(data=sent))
        images.publish(picture)

    late = []
    for _ in range(3):
        os.kill(toy.pid, signal.SIGSTOP)
        graph.every(0.008, 0.6, send)  # more than shared memory holds: some of it is missed
        os.kill(toy.pid, signal.SIGCONT)
        resumed = sent
        for _ in graph.ticks(0.008):
            send()
            if doubled and doubled[-1].data > 2 * resumed:
                break
        late.append(sent - resumed)
    assert max(late) < 100, late  # 0.8 s; until the next heartbeat of Fast DDS by itself it can be 3 s
