"""Runs of a replay: which settings each has, and all of them on all cores."""

from __future__ import annotations

import itertools
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from tactile_base.jobs import Workers, run_jobs
from tactile_base.progress import Progress
from tactile_base.settings import SettingError, unknown_name
from tactile_filter.bayes_filter import FilterSettings
from tactile_filter.filter_settings import load_filter_settings
from tactile_records.bags.contents import Recorded
from tactile_records.replay.inputs import Inputs
from tactile_records.replay.kept import FOLDER, KeptRuns, Plan
from tactile_records.replay.output import write_bag
from tactile_records.replay.report import RunResult
from tactile_records.replay.run import agreement, run_filter, series_of, smooth_run
from tactile_records.replay.settings import NAMES, recorded_settings
from tactile_records.replay.track import ArmInputs

SINGLE = "replay"
Value = bool | int | float | str


@dataclass(frozen=True)
class Options:
    """How runs are made; see the options of `tactile replay`."""

    as_recorded: bool = True
    smooth: bool = False
    copies: Sequence[Recorded] = ()


def parse_setting(text: str) -> tuple[str, list[str]]:
    """`name=a,b,c` as name and values; raises `SettingError` with the valid names."""
    name, separator, values = text.partition("=")
    if not separator or not values:
        raise SettingError(f"'{text}': must be NAME=VALUE")
    if name not in NAMES:
        raise SettingError(unknown_name(name, NAMES))
    return name, values.split(",")


def typed(name: str, text: str) -> Value:
    """A setting's value in its type; raises `SettingError`."""
    kind = type(getattr(FilterSettings(), name))
    try:
        if kind is bool:
            return {"true": True, "false": False}[text.lower()]
        return text if kind is str else kind(text)
    except (ValueError, KeyError) as error:
        raise SettingError(f"{name} = '{text}': must be of type {kind.__name__}") from error


def base_settings(inputs: Inputs, profile: Path | None) -> dict[str, FilterSettings]:
    """The settings of each arm before changes: the profile's, else the recorded, else config/filter.yaml's.

    What a recording does not name is as the live node has it then: the default.
    """
    result = {}
    for arm in inputs.arms:
        values, unknown = recorded_settings(inputs.bag.note, arm.name)
        if profile is not None:
            result[arm.name] = load_filter_settings(profile)
        elif values:
            result[arm.name] = FilterSettings.from_mapping(
                values, f"settings in the note of {inputs.bag.folder}"
            )
            if unknown:
                arm.remarks.append(
                    f"recorded settings that the filter does not have now: {', '.join(unknown)}"
                )
        else:
            arm.remarks.append(
                "the recording does not hold the filter's settings: those of config/filter.yaml"
            )
            result[arm.name] = load_filter_settings()
    return result


def make_plans(
    base: Mapping[str, FilterSettings],
    changes: Sequence[str],
    sweeps: Sequence[str],
    folder: Path,
    profile: bool = False,
) -> list[Plan]:
    """One plan for each combination of the swept values; with a profile, `base` stands against the recording.

    Raises
    ------
    SettingError
        An unknown name, or a value of the wrong type or outside its range.
    """
    fixed = {}
    for text in changes:
        name, _ = parse_setting(text)
        fixed[name] = typed(name, text.partition("=")[2])
    axes = [parse_setting(text) for text in sweeps]
    twice = [name for name, _ in axes if name in fixed or [n for n, _ in axes].count(name) > 1]
    if twice:
        raise SettingError(f"{twice[0]} is given more than once")
    plans = []
    for values in itertools.product(*(texts for _, texts in axes)):
        chosen = {name: typed(name, text) for (name, _), text in zip(axes, values, strict=True)}
        name = ",".join(f"{name}={text}" for (name, _), text in zip(axes, values, strict=True)) or SINGLE
        settings = {arm: each.replaced(**fixed, **chosen) for arm, each in base.items()}
        given = frozenset(NAMES if profile else {*fixed, *chosen})
        plans.append(Plan(name, folder / name.replace("/", "_"), settings, given))
    return plans


def run_plans(
    plans: Sequence[Plan],
    inputs: Inputs,
    options: Options,
    workers: Workers,
    progress: Progress,
    kept: KeptRuns,
) -> list[list[RunResult]]:
    """Results of all arms for each plan, kept or new; its bag is written here, wherever it runs."""
    results = {plan.name: found for plan in plans if (found := kept.results(plan)) is not None}
    missing = [plan for plan in plans if plan.name not in results]
    if results:
        progress.say(f"{len(results)} of {len(plans)} runs are done already")
    sent = replace(inputs, bag=inputs.bag.without_messages())
    work = PlannedRun(sent, options, files=bool(workers.scheduler))
    if len(plans) == 1:
        workers = replace(workers, processes=1)
    done = run_jobs(work, missing, workers, progress.say)
    for outcome in progress.counted(done, "runs", len(missing), "runs") if len(plans) > 1 else done:
        plan = outcome.job
        results[plan.name], files = outcome.result()
        if files:
            there = _empty(plan)
            there.mkdir(parents=True)
            for name, data in files.items():
                (there / name).write_bytes(data)
            there.rename(plan.bag)
        if len(plans) > 1:
            kept.keep(plan, results[plan.name])
    return [results[plan.name] for plan in plans]


@dataclass(frozen=True)
class PlannedRun:
    """Runs a plan in any process; its results and, where they are asked for, the files of its bag."""

    inputs: Inputs
    options: Options
    files: bool = False

    def __call__(self, plan: Plan) -> tuple[list[RunResult], dict[str, bytes]]:
        if not self.files:
            empty = _empty(plan)
            results = run_plan(replace(plan, bag=empty), self.inputs, self.options)
            empty.rename(plan.bag)
            return results, {}
        with TemporaryDirectory(prefix="tactile_replay_") as folder:
            there = replace(plan, bag=Path(folder) / plan.bag.name)
            results = run_plan(there, self.inputs, self.options)
            return results, {path.name: path.read_bytes() for path in there.bag.iterdir()}


def _empty(plan: Plan) -> Path:
    """Where a run's bag is until it is whole; what a process left there that was killed is gone."""
    there = plan.bag.parent / FOLDER / plan.bag.name
    shutil.rmtree(there, ignore_errors=True)
    return there


def run_plan(plan: Plan, inputs: Inputs, options: Options) -> list[RunResult]:
    """Run the filters of all arms and write the bag."""
    runs = []
    for arm in inputs.arms:
        changes = [change.without(plan.given) for change in arm.changes]
        run = run_filter(arm, plan.settings[arm.name], options.as_recorded, changes)
        if options.smooth:
            smooth_run(run)
        runs.append(run)
    write_bag(plan.bag, inputs.bag, runs, options.copies)
    results = []
    for run in runs:
        arm = run.inputs
        compared = None if arm.live is None else agreement(run.states, arm.live)
        counts = len(run.beliefs), run.left_out, dict(run.resets), dict(run.rejections)
        results.append(RunResult(plan.name, arm.name, series_of(run.beliefs), *counts, compared))
        if options.smooth:
            name, smoothed = f"{plan.name}, smoothed", series_of(run.smoothed)
            results.append(RunResult(name, arm.name, smoothed, len(run.beliefs), smoothed=True))
    return results


def same_settings(plan: Plan, inputs: Inputs, arm: ArmInputs) -> bool:
    """Whether a plan runs the filter with what the recording says that it ran with."""
    values, unknown = recorded_settings(inputs.bag.note, arm.name)
    changed = {name for change in arm.changes for name in change.values} & plan.given
    same = FilterSettings.from_mapping(values) == plan.settings[arm.name]
    return bool(values) and not unknown and not changed and same
