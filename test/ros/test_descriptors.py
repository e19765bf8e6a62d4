"""Descriptors of all settings, as rqt_reconfigure and ros2cli read them, and as people do.

The rules of rqt_reconfigure are those of src/rqt_reconfigure/param_editors.py, branch rolling (db5aed2): a
slider of a number is made of what is below, and where that raises, param_client_widget.py shows neither this
parameter nor those that follow.
"""

import dataclasses
import math

import pytest
import rclpy
import yaml
from all_settings import all_settings
from rcl_interfaces.msg import Parameter as ParameterMsg
from rclpy.parameter import Parameter, get_parameter_value

from tactile_base.settings import SettingError, Settings, setting
from tactile_bringup.launching.environment import ros_environment
from tactile_ros.parameters import SettingsParameters, meant


@dataclasses.dataclass(frozen=True)
class Odd(Settings):
    """What keeps rqt_reconfigure from showing a node, if it were said as a range."""

    endless: float = setting(1.0, lower=0.0, upper=math.inf, unit="s", doc="without end")
    open: float = setting(1.0, lower=0.0, doc="without an upper side")
    large: int = setting(0, lower=0, upper=2**32 - 1, doc="more than 32 bits")
    point: float = setting(1.0, lower=1.0, upper=1.0, doc="no width")
    plain: float = setting(0.2, lower=0.1, upper=0.3, unit="m", doc="as most are")
    whole: int = setting(2, lower=1, upper=9, doc="of these")
    gains: tuple[float, ...] = setting(
        [0.0, 1.0], length=2, lower=[0.0, -1.0], upper=[2.0, math.inf], unit="1/s", doc="two of them"
    )
    mode: str = setting("fast", choices=("fast", "exact"), doc="which")


def has_defaults(kind: type[Settings]) -> bool:
    """Others are of files alone: a parameter always has a value."""
    try:
        kind()
    except (SettingError, TypeError):
        return False
    return True


@pytest.fixture(scope="module")
def node(tmp_path_factory):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_environment(tmp_path_factory.mktemp("logs")).domain_id)
    node = rclpy.create_node("descriptors", context=context, start_parameter_services=False)
    yield node
    node.destroy_node()
    context.shutdown()


def as_rqt_shows(descriptor, value) -> str:
    """Which editor a parameter gets; raises where rqt_reconfigure does."""
    if descriptor.floating_point_range:
        found = descriptor.floating_point_range[0]
        scale = 100 / (found.to_value - found.from_value)  # DoubleEditor.__init__
        for number in (found.step, found.from_value, found.to_value, value):
            in_32_bits(round(number * scale))  # _get_value_slider, then a method of QSlider
        return "slider"
    if descriptor.integer_range:
        found = descriptor.integer_range[0]
        for number in (found.step, found.from_value, found.to_value, value):
            in_32_bits(int(number))  # IntegerEditor.__init__
        return "slider"
    return "text"


def in_32_bits(number: int) -> None:
    """PyQt refuses another one for an `int` of Qt."""
    if not -(2**31) <= number < 2**31:
        raise OverflowError(number)


def test_rqt_reconfigure_can_show_every_setting_of_ours(node):
    count = 0
    for kind in filter(has_defaults, all_settings()):
        prefix = f"{kind.__module__}.{kind.__qualname__}".replace("_", "")
        SettingsParameters(node, kind(), prefix=prefix)
        for field in dataclasses.fields(kind):
            name = f"{prefix}.{field.name}"
            as_rqt_shows(node.describe_parameter(name), node.get_parameter(name).value)
            count += 1
    assert count > 250


def test_values_lie_in_their_ranges_and_come_back_from_a_dump_as_they_were(node):
    """As ros2param writes and reads them (ros2cli, ros2param/verb/dump.py; rclpy.parameter on loading)."""
    count = 0
    for kind in filter(has_defaults, all_settings()):
        fixed = [field.name for field in dataclasses.fields(kind)][::2]
        prefix = f"dumped.{kind.__module__}.{kind.__qualname__}".replace("_", "")
        settings = SettingsParameters(node, kind(), prefix=prefix, read_only=fixed)
        for field in dataclasses.fields(kind):
            name = f"{prefix}.{field.name}"
            about, value = node.describe_parameter(name), node.get_parameter(name).value
            for found in (*about.floating_point_range, *about.integer_range):
                assert found.from_value <= value <= found.to_value and found.step == 0, name
            dumped = yaml.dump(list(value) if about.type > Parameter.Type.STRING.value else value)
            loaded = ParameterMsg(name=name, value=get_parameter_value(str(yaml.safe_load(dumped))))
            given = meant(node, [Parameter.from_parameter_msg(loaded)])
            assert bool(given) != about.read_only, name
            answer = node.set_parameters_atomically(given)
            assert answer.successful, answer.reason
            count += 1
        assert settings.value == kind()
    assert count > 250


@pytest.mark.parametrize("text", ["fast", "[1.0, two]", "[]", "[true]"])
def test_a_text_that_is_no_number_is_refused_as_it_is(node, text):
    name = f"text{len(node.list_parameters([], 0).names)}"
    node.declare_parameter(name, 1.0)
    message = ParameterMsg(name=name, value=get_parameter_value(text))
    answer = node.set_parameters_atomically(meant(node, [Parameter.from_parameter_msg(message)]))
    assert not answer.successful and node.get_parameter(name).value == 1.0


def test_a_range_is_said_where_it_can_be_and_always_in_words(node):
    SettingsParameters(node, Odd(), prefix="odd", read_only=["open"])
    about = {f.name: node.describe_parameter(f"odd.{f.name}") for f in dataclasses.fields(Odd)}
    shown = {name: as_rqt_shows(each, getattr(Odd(), name)) for name, each in about.items()}
    assert {name for name, editor in shown.items() if editor == "slider"} == {"plain", "whole"}
    said = {name: each.description for name, each in about.items()}
    assert said["endless"] == "without end; in [0, inf] s; started with 1.0"
    assert said["gains"] == "two of them; 2 elements; in [0, 2], [-1, inf] 1/s; started with [0.0, 1.0]"
    assert said["mode"] == "which; one of fast, exact; started with fast"
    assert said["open"] == "without an upper side; in [0, inf)" and about["open"].read_only
    assert all(each.type != Parameter.Type.NOT_SET.value for each in about.values())


def test_a_description_tells_the_value_that_was_given_at_the_start(node):
    context = node.context
    given = [Parameter("late.plain", value=0.25)]
    other = rclpy.create_node(
        "given", context=context, parameter_overrides=given, start_parameter_services=False
    )
    try:
        SettingsParameters(other, Odd(), prefix="late")
        other.set_parameters([Parameter("late.plain", value=0.15)])
        assert other.describe_parameter("late.plain").description.endswith("; started with 0.25")
    finally:
        other.destroy_node()
