"""Runs that begin alike: run once up to a moment, from which each goes on in a process of its own.

    lies, records = branch("plane", "surface_following", "fitted", 6.0, estimates, "frozen", 6.0, "arm")

gives what `run_arms_offline` would with `lies=estimates("frozen", 6.0, "arm")`, to the bit
(`test_branches.py`), without the six seconds before the lie. What waits at the moment is a fork of this
process, which ends with the module's tests (`conftest.py`).
"""

import os
import traceback
import warnings
from collections import defaultdict, deque
from multiprocessing import Pipe
from types import SimpleNamespace
from typing import ClassVar

from tactile_base.stamps import SECOND_NS
from tactile_bringup.offline import OfflineOptions, run_arms_offline
from tactile_doubles.lies import Lies
from tactile_perception.estimating.perceive import DepthAgreement

BEFORE = 0.05  # s before a lie, in which it sees the truth


def branch(scene, task, fidelity, begins, make, *arguments, seed=0, goals=()):
    """What comes of `make(*arguments)`, some `Lies` that begin at a time (s): they and the records by arm.

    Of the lies `begins_ns` and what is told of the run: `witness`, and `before` and `deepest` if they have
    them. The task may be a function that loads one.
    """
    if begins <= BEFORE:
        lies = make(*arguments)
        return lies, _run(scene, task, fidelity, seed, goals, lies)
    # what a test has put in place of the agreement holds in the fork as well
    agreement = DepthAgreement.__call__
    return _Beginning.of(scene, task, fidelity, begins, seed, goals, agreement).go_on(make, arguments)


def _run(scene, task, fidelity, seed, goals, lies):
    options = OfflineOptions(fidelity=fidelity, seed=seed, goals=goals, lies=lies)
    return run_arms_offline(scene, task() if callable(task) else task, options)


class _Beginning:
    """The process that waits."""

    waiting: ClassVar[dict] = {}

    @classmethod
    def of(cls, *run):
        if run not in cls.waiting:
            cls.waiting[run] = cls(*run)
        return cls.waiting[run]

    def __init__(self, scene, task, fidelity, begins, seed, goals, _agreement):
        self._requests, there = Pipe()
        with warnings.catch_warnings():  # of the thread that ends a test which hangs; it holds nothing
            warnings.simplefilter("ignore", DeprecationWarning)
            self._process = os.fork()
        if self._process:
            there.close()
            return
        self._requests.close()
        try:
            lies = _Undecided(begins, there)
            records = _run(scene, task, fidelity, seed, goals, lies)
            there.send((lies.told(), records))
        except BaseException:
            there.send((None, traceback.format_exc()))
        finally:
            os._exit(0)

    def go_on(self, make, arguments):
        self._requests.send((make, arguments))
        lies, records = self._requests.recv()
        assert lies is not None, records
        return lies, records

    def end(self):
        self._requests.close()
        os.waitpid(self._process, 0)


def end_all():
    """End what waits: the youngest first, since it holds the pipes of the older ones open."""
    while _Beginning.waiting:
        _Beginning.waiting.popitem()[1].end()


class _Undecided(Lies):
    """Tells the truth up to a moment, and is from then on what is asked for, each time in another fork."""

    def __init__(self, begins, requests):
        super().__init__(begins)
        self._requests, self._lies = requests, None
        self._drivers = {}
        self._seen = defaultdict(lambda: deque(maxlen=60))  # by whose and what, as long as any lie remembers

    def driver(self, name, arm):
        self._drivers[name] = _Driver(arm)
        return self._drivers[name]

    def image(self, name, stamp_ns, image):
        return self._pass_on("image", name, stamp_ns, image)

    def estimate(self, name, stamp_ns, estimate):
        return self._pass_on("estimate", name, stamp_ns, estimate)

    def _pass_on(self, what, *seen):
        if self._lies is not None:
            return getattr(self._lies, what)(*seen)
        self._seen[what, seen[0]].append(seen)
        return seen[-1]

    def see(self, cell):
        if self._lies is None and cell.stamp_ns >= self.begins_ns - BEFORE * SECOND_NS:
            self._lies = self._decided()
            for (what, _), seen in self._seen.items():
                for one in seen:
                    getattr(self._lies, what)(*one)
            for name, driver in self._drivers.items():
                driver.become(self._lies.driver(name, driver.arm))
        if self._lies is not None:
            self._lies.see(cell)

    def _decided(self):
        while True:
            try:
                make, arguments = self._requests.recv()
            except EOFError:
                os._exit(0)
            child = os.fork()
            if not child:
                return make(*arguments)
            if os.waitpid(child, 0)[1]:
                self._requests.send((None, f"{make.__name__}{arguments}: the process was killed"))

    def told(self):
        names = ("begins_ns", "witness", "before", "deepest")
        return SimpleNamespace(**{name: vars(self._lies)[name] for name in names if name in vars(self._lies)})


class _Driver:
    """The driver of an arm until it is known who drives it; that one learns what was commanded last."""

    def __init__(self, arm):
        self.arm, self._driver, self._told = arm, arm, None

    def __getattr__(self, name):
        return getattr(self._driver, name)

    def command(self, stamp_ns, twist):
        self._told = stamp_ns, twist
        self._driver.command(stamp_ns, twist)

    def stop(self, reason):
        self._told = None
        self._driver.stop(reason)

    def become(self, driver):
        self._driver = driver
        if driver is not self.arm and self._told is not None:
            driver.command(*self._told)
