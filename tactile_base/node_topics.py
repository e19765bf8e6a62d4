"""Who publishes, hears and serves what: the table of topics by node, of which permissions are made.

A node that the table does not let publish a topic may not, where DDS security is on (`tactile security`).
"""

from __future__ import annotations

from dataclasses import dataclass

from tactile_base import topics
from tactile_base.topics import Topic

_PARAMETERS = ("describe_parameters", "get_parameter_types", "get_parameters", "list_parameters")
_SET = ("set_parameters", "set_parameters_atomically", "get_type_description")
_LIFECYCLE = ("change_state", "get_available_states", "get_available_transitions", "get_transition_graph")
GET_STATE = "get_state"
#: Services of every node, below its own name.
NODE_SERVICES = (*_PARAMETERS, *_SET, *_LIFECYCLE, GET_STATE)
#: Who starts a task (`tactile launch`, `tactile run`): a plain node, which hears what arms do.
CLIENT = "/tactile_launch"
#: Who looks (`tactile view`, `tactile foxglove`): plain nodes that hear what is said, and send nothing.
VIEW, FOXGLOVE = "/tactile_view", "/tactile_foxglove"
LAUNCH_LOG = "tactile_launch"  # what it is called in /rosout
ARM = "arm"
LAST_ZEROS = "last_zeros"  # a plain node beside that of an arm which moves by joint velocities
TRANSITION_EVENT = "transition_event"  # below the node's name


@dataclass(frozen=True)
class Part:
    """What a node has to do with others.

    Attributes
    ----------
    publishes, hears : topics of its own arm, or of all arms together
    publishes_all, hears_all : topics of each arm of the scene
    serves : services, below its namespace, or `~/` its own name
    does : actions that it executes, below its namespace
    """

    publishes: tuple[Topic, ...] = ()
    hears: tuple[Topic, ...] = ()
    publishes_all: tuple[Topic, ...] = ()
    hears_all: tuple[Topic, ...] = ()
    serves: tuple[str, ...] = ()
    does: tuple[str, ...] = ()


_FRAMES = (topics.TF, topics.TF_STATIC)

#: What every node does besides; it hears commands while it ends, to go on as long as somebody moves its arm.
EVERY_NODE = Part(
    publishes=(topics.ROSOUT, topics.DIAGNOSTICS, topics.PARAMETER_EVENTS), hears_all=(topics.COMMAND,)
)

#: By the node's name. A recorder hears the topics that its parameters name; the node of an external arm says
#: and hears what the scene's `driver_settings` name besides.
NODES: dict[str, Part] = {
    ARM: Part(
        publishes=(
            topics.ARM_POSE,
            topics.ARM_STATUS,
            topics.LIMITED_COMMAND,
            topics.EXTERNAL_COMMAND,
            topics.JOINT_STATES,
            topics.ROBOT_DESCRIPTION,
            *_FRAMES,
        ),
        hears=(topics.COMMAND, topics.ESTOP, topics.STATE, topics.FORCE_BELIEF, *_FRAMES),
        hears_all=(topics.JOINT_STATES,),
        serves=("arm/estop", "arm/reset"),
    ),
    "camera": Part(publishes=(topics.IMAGE, topics.LATENCY)),
    "sim": Part(
        publishes=(topics.TF, topics.SIM_MARKERS),
        publishes_all=(
            topics.TRUTH,
            topics.PRESENCE,
            topics.ESTIMATE,
            topics.FORCE_SENSOR,
            topics.LATENCY,
        ),
    ),
    "estimator": Part(
        publishes=(topics.PRESENCE, topics.ESTIMATE, topics.WRENCH, topics.FORCE_ESTIMATE, topics.LATENCY),
        hears=(topics.IMAGE, topics.compressed(topics.IMAGE)),
        serves=("~/capture_reference",),
    ),
    "marker_view": Part(
        publishes=(topics.MARKER_VIEW,),
        hears=(topics.IMAGE, topics.compressed(topics.IMAGE)),
        serves=("~/capture_reference",),
    ),
    "filter": Part(
        publishes=(topics.BELIEF, topics.STATE, topics.FORCE_BELIEF, topics.LATENCY, topics.TF),
        hears=(topics.PRESENCE, topics.ESTIMATE, topics.FORCE_ESTIMATE, *_FRAMES),
        serves=("~/reset",),
    ),
    "controller": Part(
        publishes=(topics.COMMAND, topics.CONTROLLER_STATUS, topics.PATH, topics.LATENCY),
        hears=(
            topics.ARM_STATUS,
            topics.STATE,
            topics.FORCE_BELIEF,
            topics.DIAGNOSTICS,
            topics.IMAGE,
            topics.compressed(topics.IMAGE),
            topics.FORCE_SENSOR,
            *_FRAMES,
        ),
        hears_all=(topics.CONTROLLER_STATUS,),  # of the arms that it works together with
        does=(topics.RUN_TASK,),
    ),
    "object": Part(
        publishes=(topics.OBJECT_BELIEF, topics.OBJECT_LATENCY, topics.TF),
        hears=_FRAMES,
        hears_all=(topics.BELIEF, topics.STATE),
        serves=("~/reset",),
    ),
    "recorder": Part(),
}
