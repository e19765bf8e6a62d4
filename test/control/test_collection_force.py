"""Contacts labelled with what a force sensor says: taring, silence, and a sensor that has its sign wrong."""

import dataclasses

import numpy as np
import pytest
from collected import Look, Store
from test_collection import POSES, QUICK, TARGETS, Bench, frame, phases, run

from tactile_control.force_reference import StampedForce
from tactile_geometry import se3
from tactile_records.collecting.inputs import MeasuredForces
from tactile_records.collecting.settings import CollectionGoal, ForceLabelSettings
from tactile_records.collecting.task import DataCollection

MS = 1_000_000
LABELLED = QUICK.replaced(force__labelled=True, force__window=0.05)
WEIGHT, OFFSET = np.array([0.0, 0.0, -1.2]), np.array([0.4, -0.2, 3.0])  # N, in the base; N, in {s}
STIFFNESS = 700.0  # N/m


class ForceBench(Bench):
    """With a force sensor between arm and tip, which bears the tip's weight and is not set to zero."""

    silent, sign = False, 1

    def pressed(self, T) -> np.ndarray:
        """The surface's force on the sensor in {s}: a spring along the surface's normal."""
        depth = max(0.0, 0.02 - T[2, 3])
        return T[:3, :3].T @ np.array([0.0, 0.0, STIFFNESS * depth])

    def collection_inputs(self):
        stamp, T = self.history[-1]
        said = self.pressed(T) + T[:3, :3].T @ WEIGHT + OFFSET
        measured = () if self.silent else (StampedForce(stamp, self.sign * said),)
        return dataclasses.replace(super().collection_inputs(), measured=measured)


def collection(settings=LABELLED, targets=TARGETS) -> DataCollection:
    settings = settings.replaced(data__frame=tuple(se3.euler_from_pose(frame()).tolist()))
    task = DataCollection(settings, CollectionGoal(samples=len(targets)), store=Store(), look=Look())
    task.targets = list(targets)
    return task


@pytest.mark.parametrize("sign", [1, -1])
def test_a_label_is_the_surfaces_force_without_weight_and_offset(sign):
    task, bench = collection(LABELLED.replaced(force__sign=sign)), ForceBench()
    bench.sign = sign
    commands = run(task, bench)
    assert commands[-1].succeeded, commands[-1].reason
    for capture in task.store.captures:
        np.testing.assert_allclose(capture.force, bench.pressed(capture.T_base_sensor), atol=0.02)
    assert len(task.store.captures) == len(POSES)


def test_it_is_tared_at_rest_in_the_air_turned_as_in_contact():
    task, bench, depths = collection(targets=TARGETS[:1]), ForceBench(), []
    commands = run(task, bench, each=lambda command: depths.append((command.phase, bench.depth)))
    assert phases(commands) == [
        "go_to_start", "reference", "rotate", "tare", "contact", "shear", "capture", "retreat", "done",
    ]  # fmt: skip
    assert all(depth < 0.0 for phase, depth in depths if phase == "tare")
    assert not any(np.any(command.twist) for command in commands if command.phase == "tare")


@pytest.mark.parametrize("phase", ["tare", "capture"])
def test_a_force_sensor_that_falls_silent_ends_it_off_the_surface_and_keeps_nothing_of_that_contact(phase):
    task, bench = collection(), ForceBench()

    def fall_silent(command):
        bench.silent = bench.silent or command.phase == phase

    commands = run(task, bench, each=fall_silent)
    assert not commands[-1].succeeded and "the force sensor said nothing" in commands[-1].reason
    assert not task.store.captures and bench.depth < 0.0 and np.all(commands[-1].twist == 0.0)


def test_a_force_with_the_wrong_sign_ends_it_and_says_what_to_set():
    task, bench = collection(), ForceBench()
    bench.sign = -1
    commands = run(task, bench)
    assert "set force.sign = -1" in commands[-1].reason and not task.store.captures
    assert bench.depth < 0.0


def test_without_a_force_sensor_nothing_is_labelled_and_nothing_waits_for_it():
    task = collection(QUICK, TARGETS[:1])
    commands = run(task, ForceBench())
    assert commands[-1].succeeded and task.store.captures[0].force is None
    assert "tare" not in phases(commands)


def test_a_mean_is_of_what_came_within_the_window_and_not_before_it_is_over():
    forces = MeasuredForces(ForceLabelSettings(labelled=True, window=0.1))
    assert forces.force(0) is None and not forces.tare(0)
    values = np.arange(0.0, 30.0)
    forces.take(StampedForce(round(k * 10 * MS), np.full(3, value)) for k, value in enumerate(values[:15]))
    assert forces.force(100 * MS) is None
    forces.take(StampedForce(round(k * 10 * MS), np.full(3, value)) for k, value in enumerate(values))
    assert forces.tare(0) and forces.force(100 * MS) == pytest.approx([15.0 - 5.0] * 3)
    assert forces.force(295 * MS) is None
    rare = MeasuredForces(ForceLabelSettings(labelled=True, window=0.0))
    rare.take([StampedForce(7 * MS, np.full(3, 2.0)), StampedForce(9 * MS, np.full(3, 4.0))])
    assert rare.force(5 * MS) == pytest.approx([2.0] * 3), "however rarely the sensor says something"
