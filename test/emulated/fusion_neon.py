"""The C of SE(3) and of fusion on NEON: its tests on an emulated aarch64 processor, its bits beside x86-64's.

    python test/emulated/fusion_neon.py [options of pytest]

Needs `pip install ziglang unicorn` and the extra `test`.


What the modules have without Python is compiled for aarch64 by `zig cc` (clang) with the flags of setup.py,
and executed by `unicorn` as a Cortex-A53, which knows no more than every aarch64 has. `Emulated` takes the
place of `tactile_geometry._se3` and `tactile_filter._fusion`: their tests, with their bounds against 60
digits, run on what the emulated processor answers, and each answer is compared with that of this machine's
best instruction set.

It proves that NEON's arithmetic and data movement are right, and counts instructions. It says nothing about
speed, about the code that GCC makes of the same source, and about the arguments' way from Python; sin, cos,
atan2 and hypot are this machine's.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import struct
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
MISSING = [
    name for name in ("ziglang", "unicorn", "pytest", "mpmath") if importlib.util.find_spec(name) is None
]

TESTS = ["geometry/test_se3"] + [
    f"filter/test_{name}" for name in ("worst_errors", "fusion", "fusion_exact", "propagation")
]
STATISTICS = "errors_of_fused_poses"  # 60000 fusions for a property of the method, whatever the processor
NUMBERS = [("step", "f8"), ("iterations", "i4"), ("status", "i4")]
OUTPUT = np.dtype([("mean", "f8", (4, 4)), ("cov", "f8", (6, 6)), ("factor", "f8", (6, 6)), *NUMBERS])


class Refused(Exception):
    """What the module says of a pair that cannot be fused: its code."""


def doubles(*arrays: Any) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(array, np.float64) for array in arrays)


def as_pose(T: Any) -> np.ndarray:
    """The C's struct Pose (12,) of a matrix."""
    (T,) = doubles(T)
    return np.concatenate((T[:3, :3].ravel(), T[:3, 3]))


def as_matrix(pose: np.ndarray) -> np.ndarray:
    return np.vstack((np.column_stack((pose[:9].reshape(3, 3), pose[9:])), np.eye(4)[3]))


class Emulated:
    """In the place of a module: that checks the arguments, the emulated processor answers.

    Both answers are compared. What stands in no table of routines, and is added by no subclass, is the
    module's own.

    Parameters
    ----------
    header : str
        Where the table is declared.
    routines : str
        How the names of the tables begin.
    """

    def __init__(self, native: ModuleType, header: str, routines: str) -> None:
        from aarch64 import Machine, build

        with tempfile.TemporaryDirectory() as folder:
            machine = Machine(build(native.__name__, Path(folder)))
        self.native, self.machine, self.select = native, machine, f"{routines}_select"
        members = re.findall(r"\(\*(\w+)\)\(", (ROOT / header).read_text())
        table = machine.read(machine.symbols[f"{routines}_base"] + 8, 8 * len(members))
        self.routines = dict(zip(members, struct.unpack(f"<{len(members)}Q", table), strict=True))
        self.calls: Counter[str] = Counter()
        self.others: defaultdict[str, list[float]] = defaultdict(list)

    def __getattr__(self, name: str) -> Any:
        if name in self.routines:
            return partial(self._map, name)
        return getattr(self.native, name)

    def compare(self, name: str, *pairs: tuple[Any, Any]) -> None:
        """Note a call, and where bits differ by how much, relative to the largest element of an array."""
        self.calls[name] += 1
        worst = 0.0
        for expected, found in (map(np.asarray, pair) for pair in pairs):
            if expected.dtype != found.dtype or expected.tobytes() != found.tobytes():
                error = np.abs(expected - found).max()
                worst = max(worst, float(error / np.abs(expected).max()) if error else 0.0)
                worst = worst or 5e-324  # zeros of another sign
        if worst:
            self.others[name].append(worst)

    def instruction_set(self, name: str = "base", /) -> str:
        """What the emulated processor has."""
        if not self.machine.run(self.machine.symbols[self.select], name.encode() + b"\0"):
            raise ValueError(f"instruction set '{name}': this machine does not have it")
        return name

    def table(self) -> str:
        """How many calls had other bits, and by how much these were off."""
        beside = f"{self.native.__name__} beside {self.native.instruction_set()}"
        lines = [f"{beside:46}{'calls':>8}{'other bits':>12}{'at most':>10}"]
        for name, count in sorted(self.calls.items()):
            off = self.others[name]
            lines.append(f"{name:46}{count:8}{len(off):12}" + (f"{max(off):10.1e}" if off else ""))
        return "\n".join(lines)

    def _map(self, name: str, argument: Any, /) -> np.ndarray:
        """exp, log, adjoint or one of the Jacobians."""
        expected = getattr(self.native, name)(argument)
        found = np.full(expected.shape, np.nan)
        self.machine.run(self.routines[name], found, *doubles(argument), outputs=[found])
        self.compare(name, (expected, found))
        return found


class EmulatedSe3(Emulated):
    """`tactile_geometry._se3`."""

    def orthonormalized(self, T: Any, /) -> np.ndarray:
        expected, pose = self.native.orthonormalized(T), as_pose(T)
        self.machine.run(self.machine.symbols["se3_orthonormalize"], pose, outputs=[pose])
        self.compare("orthonormalized", (expected, as_matrix(pose)))
        return as_matrix(pose)


class EmulatedFusion(Emulated):
    """`tactile_filter._fusion`."""

    def predict(self, mean: Any, cov: Any, T_before: Any, T_now: Any, variances: Any, /) -> tuple:
        expected = self.native.predict(mean, cov, T_before, T_now, variances)
        outputs = [np.full(12, np.nan), np.full((6, 6), np.nan)]
        start, before, now = map(as_pose, (mean, T_before, T_now))
        inputs = doubles(start, cov, before, now, variances)
        self.machine.run(self.machine.symbols["propagate"], *outputs, *inputs, outputs=outputs)
        found = as_matrix(outputs[0]), outputs[1]
        self.compare("predict", *zip(expected, found, strict=True))
        return found

    def innovation(self, mean_1: Any, cov_1: Any, mean_2: Any, cov_2: Any, /) -> tuple[float, np.ndarray]:
        expected, whitened = self.native.innovation(mean_1, cov_1, mean_2, cov_2), np.full(6, np.nan)
        inputs = doubles(as_pose(mean_1), cov_1, as_pose(mean_2), cov_2)
        self.machine.run(self.machine.symbols["innovation"], whitened, *inputs, outputs=[whitened])
        found = self.machine.real(), whitened
        self.compare("innovation", *zip(expected, found, strict=True))
        return found

    def check(self, mean: Any, cov: Any, /) -> int:
        expected = self.native.check(mean, cov)
        found = self.machine.run(self.routines["check"], doubles(mean, cov)) % 2**32
        self.compare("check", (expected, found))
        return found

    def set_up(self, result: type, statuses: tuple, plans: dict, refuse: Callable[..., Any], /) -> None:
        self.plans, self.statuses, self.refuse = plans, statuses, refuse

        def tell(code: int, inputs: Any) -> None:
            raise Refused(code)

        self.native.set_up(result, statuses, plans, tell)

    def fuse(self, *args: Any) -> Any:
        expected, code = None, 0
        try:
            expected = self.native.fuse(*args)
        except Refused as refused:
            (code,) = refused.args
        plan = self.plans[args[4]] if isinstance(args[4], str) else args[4]
        name = "fuse to convergence" if plan[1] == -1 else "fuse"
        inputs, output = doubles(*args[:4]), np.zeros((), OUTPUT)
        fault = self.machine.run(self.routines["fuse"], output, inputs, *plan, outputs=[output]) % 2**32
        if fault or code:
            self.compare(f"{name}, refused", (code, fault))
            return self.refuse(fault, args[:4])
        found = {field: output[field] for field in OUTPUT.names}
        self.compare(name, *((np.asarray(getattr(expected, n), a.dtype), a) for n, a in found.items()))
        numbers = {"step": found["step"].item(), "iterations": found["iterations"].item()}
        return expected._replace(**{**found, **numbers, "status": self.statuses[found["status"]]})


def run_extremes(fusion: ModuleType) -> None:
    """Every extreme case of the tests in every mode."""
    from fusion_cases import cases

    for seed in range(3):
        for pair in cases(seed).values():
            for mode in fusion.MODES:
                fusion.fuse(*pair, mode)


def print_instructions(machine: Any, fusion: ModuleType) -> None:
    """What a fusion executes."""
    from fusion_cases import cases

    found = machine.count(partial(fusion.fuse, *cases(0)["contact"]))
    numbers = ", ".join(f"{number} {name}" for name, number in found.items())
    print(f"\nexecuted instructions of one fusion, mode paper: {numbers}")


def main() -> int:
    """Build, test, compare, count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options = parser.parse_known_args()[1]
    if MISSING:
        raise SystemExit(
            f"fusion_neon.py needs {', '.join(MISSING)}: pip install ziglang unicorn pytest mpmath"
        )
    os.chdir(ROOT)
    folders = ("", "test/filter", "test/geometry", "test/emulated")
    sys.path[:0] = [str(ROOT / name) for name in folders]
    import pytest

    from tactile_geometry import _se3

    emulated_se3 = EmulatedSe3(_se3, "tactile_geometry/_csrc/se3_routines.h", "se3_routines")
    sys.modules[_se3.__name__] = sys.modules["tactile_geometry"]._se3 = emulated_se3
    from tactile_filter import _fusion

    emulated = EmulatedFusion(_fusion, "tactile_filter/_csrc/routines.h", "routines")
    sys.modules[_fusion.__name__] = sys.modules["tactile_filter"]._fusion = emulated
    files = [f"test/{name}.py" for name in TESTS]
    failed = pytest.main([*files, "-q", "-o", "timeout=0", "-k", f"not {STATISTICS}", *options])

    from tactile_filter import fusion

    run_extremes(fusion)
    print(f"\n{emulated_se3.table()}\n\n{emulated.table()}")
    print_instructions(emulated.machine, fusion)
    return int(failed or any(emulated_se3.others.values()) or any(emulated.others.values()))


if __name__ == "__main__":
    sys.exit(main())
