"""The table of topics and frames: each name, type and quality of service stands here, and nowhere else.

Names of an arm's topics are relative to its namespace (`/<arm>`); those with a leading slash are global.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

RELIABLE, LATCHED, SENSOR = "reliable", "latched", "sensor"
QOS_KINDS = (RELIABLE, LATCHED, SENSOR)


@dataclass(frozen=True)
class Topic:
    """A topic.

    Attributes
    ----------
    name : below an arm's namespace, or absolute
    type : `package/msg/Name`; of what an action publishes `package/action/Name_FeedbackMessage`
    qos : "reliable"; "latched": reliable, and late subscribers get the last message; or "sensor": best effort
    publisher : who publishes it; empty where the table does not say, as for topics that users name
    """

    name: str
    type: str
    qos: str = RELIABLE
    publisher: str = ""

    def of(self, arm: str) -> Topic:
        """The topic of an arm, with its absolute name."""
        return dataclasses.replace(self, name=f"/{arm}/{self.name}")

    def arm_of(self, name: str) -> str | None:
        """The arm whose topic of this kind has the absolute name; None for other topics."""
        suffix = f"/{self.name}"
        return name[1 : -len(suffix)] if name.endswith(suffix) and len(name) > len(suffix) else None


_POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"

# ---- of each arm ----

ARM_POSE = Topic("arm/pose", "geometry_msgs/msg/PoseStamped", RELIABLE, "arm")
ARM_STATUS = Topic("arm/status", "tactile_msgs/msg/ArmStatus", RELIABLE, "arm")
COMMAND = Topic("command/request", "tactile_msgs/msg/ArmCommand", RELIABLE, "controller")
JOINT_STATES = Topic("joint_states", "sensor_msgs/msg/JointState", RELIABLE, "arm")
ROBOT_DESCRIPTION = Topic("robot_description", "std_msgs/msg/String", LATCHED, "arm")
CONTROLLER_STATUS = Topic("controller/status", "tactile_msgs/msg/ControllerStatus", RELIABLE, "controller")
PATH = Topic("controller/path", "geometry_msgs/msg/PoseArray", RELIABLE, "controller")
EXTERNAL_COMMAND = Topic("command/twist", "geometry_msgs/msg/TwistStamped", RELIABLE, "arm")
LIMITED_COMMAND = Topic("command/twist_limited", "geometry_msgs/msg/TwistStamped", RELIABLE, "arm")

# ---- of each arm with a sensor ----

IMAGE = Topic("tactile/image", "sensor_msgs/msg/Image", SENSOR, "camera")
FORCE_SENSOR = Topic("force_sensor/wrench", "geometry_msgs/msg/WrenchStamped", SENSOR, "a force sensor")
MARKER_VIEW = Topic("tactile/marker_view", "sensor_msgs/msg/Image", SENSOR, "marker_view")
PRESENCE = Topic("contact/presence", "tactile_msgs/msg/ContactPresence", RELIABLE, "estimator")
ESTIMATE = Topic("contact/estimate", _POSE_WITH_COVARIANCE, RELIABLE, "estimator")
BELIEF = Topic("contact/belief", _POSE_WITH_COVARIANCE, RELIABLE, "filter")
STATE = Topic("contact/state", "tactile_msgs/msg/ContactState", RELIABLE, "filter")
WRENCH = Topic("contact/wrench", "geometry_msgs/msg/WrenchStamped", RELIABLE, "estimator")
FORCE_ESTIMATE = Topic(
    "contact/wrench_estimate", "tactile_msgs/msg/ContactForce", RELIABLE, "estimator"
)  # the same with its covariance
FORCE_BELIEF = Topic("contact/wrench_belief", "tactile_msgs/msg/ContactForce", RELIABLE, "filter")
SMOOTHED = Topic("contact/smoothed", _POSE_WITH_COVARIANCE, RELIABLE, "tactile replay")
TRUTH = Topic("sim/truth", "tactile_msgs/msg/ContactTruth", RELIABLE, "simulation")
LATENCY = Topic("latency", "tactile_msgs/msg/StageLatency", RELIABLE, "every stage")

RUN_TASK = "run_task"  # the action of each arm's controller
TASK_STATUS = Topic(f"{RUN_TASK}/_action/status", "action_msgs/msg/GoalStatusArray", LATCHED, "controller")
TASK_FEEDBACK = Topic(
    f"{RUN_TASK}/_action/feedback", "tactile_msgs/action/RunTask_FeedbackMessage", RELIABLE, "controller"
)

# ---- of all arms together ----

ESTOP = Topic("/estop", "std_msgs/msg/Bool", RELIABLE, "whoever stops all arms")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", RELIABLE, "every node")
PARAMETER_EVENTS = Topic("/parameter_events", "rcl_interfaces/msg/ParameterEvent", RELIABLE, "every node")
TF = Topic("/tf", "tf2_msgs/msg/TFMessage", RELIABLE, "arm, filter and object")
TF_STATIC = Topic("/tf_static", "tf2_msgs/msg/TFMessage", LATCHED, "arm")
ROSOUT = Topic("/rosout", "rcl_interfaces/msg/Log", LATCHED, "every node")
SIM_MARKERS = Topic("/sim/markers", "visualization_msgs/msg/MarkerArray", LATCHED, "simulation")
OBJECT_BELIEF = Topic("/object/belief", _POSE_WITH_COVARIANCE, RELIABLE, "object")
OBJECT_LATENCY = Topic("/object/latency", "tactile_msgs/msg/StageLatency", RELIABLE, "object")

# ---- what a graph has, and a recorder records ----

ARM_TOPICS = (
    ARM_POSE,
    ARM_STATUS,
    COMMAND,
    LIMITED_COMMAND,
    CONTROLLER_STATUS,
    PATH,
    TASK_STATUS,
    TASK_FEEDBACK,
)
#: Those of the force have messages only where the network tells it.
FORCE_TOPICS = (WRENCH, FORCE_ESTIMATE, FORCE_BELIEF)
SENSOR_TOPICS = (PRESENCE, ESTIMATE, BELIEF, STATE, TRUTH, LATENCY, *FORCE_TOPICS, FORCE_SENSOR)
SHARED_TOPICS = (DIAGNOSTICS, PARAMETER_EVENTS, ROSOUT, ESTOP, TF, TF_STATIC, SIM_MARKERS)
OBJECT_TOPICS = (OBJECT_BELIEF, OBJECT_LATENCY)


def compressed(image: Topic) -> Topic:
    """The topic of the same images, compressed."""
    return Topic(f"{image.name}/compressed", "sensor_msgs/msg/CompressedImage", image.qos, "recorder")


# ---- frames ----

WORLD = "world"
OBJECT = "object"


def base_frame(arm: str) -> str:
    """Where the arm stands; it does not move."""
    return f"{arm}/base"


def tool_frame(arm: str) -> str:
    """The arm's flange."""
    return f"{arm}/tool"


def sensor_frame(arm: str) -> str:
    """The tactile sensor {s}: the centre of its dome, z out of the tip."""
    return f"{arm}/tactile_sensor"


def contact_frame(arm: str) -> str:
    """The feature {f} that the sensor touches, by the filter's belief."""
    return f"{arm}/contact"


def link_frame(arm: str, link: str) -> str:
    """A link of the URDF that describes an arm."""
    return f"{arm}/urdf/{link}"


def body_frame(body: str) -> str:
    """A body of the simulated cell that a motion model moves."""
    return f"body/{body}"
