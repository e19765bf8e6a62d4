"""Tasks, one file each; another package adds one by an entry point of the group tactile_servoing.tasks."""

from __future__ import annotations

from collections.abc import Iterator

from tactile_base.contract import Contract
from tactile_base.registry import Registry
from tactile_control.phase_machine import PhaseMachine
from tactile_control.phases import DONE, FAILED


def _phases(kind: type[PhaseMachine]) -> Iterator[str]:
    """What its phases lack."""
    from tactile_control.contact_task import ContactTask

    for name in (kind.work, DONE, FAILED):
        if name not in kind.phases:
            yield f"phases {list(kind.phases)} lack '{name}'"
    own = [getattr(kind, name, None) is getattr(ContactTask, name) for name in ("finished", "own_phases")]
    if all(own) and not kind.endless:
        yield "has no finished(elapsed) and no own_phases(): nothing ends it"


TASKS: Registry[type[PhaseMachine]] = Registry(
    "task",
    "tactile_servoing.tasks",
    {
        "surface_following": "tactile_control.tasks.surface_following:SurfaceFollowing",
        "object_tracking": "tactile_control.tasks.object_tracking:ObjectTracking",
        "pushing": "tactile_control.tasks.pushing:Pushing",
        "trajectory": "tactile_control.tasks.trajectory:Trajectory",
        "move": "tactile_control.tasks.move:Move",
        "touching": "tactile_control.tasks.touching:Touching",
        "data_collection": "tactile_records.collecting.task:DataCollection",
    },
    Contract(
        ("settings", "goal", "start"),
        {"configure": ("settings",)},
        settings=True,
        attributes=("goal_class", "phases", "work"),
        base=lambda: PhaseMachine,
        also=_phases,
    ),
)
