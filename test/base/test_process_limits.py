"""What is said of a machine that has too much to do."""

import os

import pytest

from tactile_base.process_limits import overload


@pytest.mark.parametrize(("cores", "wanted", "said"), [(2, 2.9, False), (2, 3.1, True), (8, 9.0, False)])
def test_a_machine_is_overloaded_from_one_and_a_half_processes_a_core_on(monkeypatch, cores, wanted, said):
    monkeypatch.setattr(os, "getloadavg", lambda: (wanted, 0.0, 0.0))
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(cores)))
    assert bool(overload()) == said
    assert not said or f"{wanted:.1f} processes at a time wanted its {cores} cores" in overload()
