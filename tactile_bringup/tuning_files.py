"""What was tuned, as files that the next launch takes: of controllers and filters, or in a task file."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from tactile_base.settings import SettingError, SettingGroups
from tactile_base.whole_file import whole_file
from tactile_base.yaml_edit import YamlEditError, with_values
from tactile_base.yaml_file import read_yaml, value_text
from tactile_bringup.tuning import Tuning, plain
from tactile_control.task_file import TASK_GROUPS, Role, Task, load_task, task_path
from tactile_control.tasks import TASKS
from tactile_filter.filter_settings import FilterSettings

FOLDER = Path("out/tune")
Groups = dict[str, dict[str, Any]]  # group -> name -> value


def saved(tuning: Tuning, where: Path = FOLDER) -> list[str]:
    """Save what differs from what the nodes were started with; returns what was written and how to launch it.

    Parameters
    ----------
    where : Path
        A task file that is there, whose roles get the settings of their controllers; or a folder for files of
        controllers (`--controller`), filters (`--filter`), and ROS parameters of what only these can hold.

    Raises `SettingError` where nothing differs, or the task file cannot take it; it is then as it was;
    `OSError` where a file cannot be written.
    """
    if not tuning.different():
        raise SettingError("nothing differs from what the nodes were started with: there is nothing to save")
    if where.is_file():
        return _into_task(tuning, where)
    if where.suffix:
        raise SettingError(f"{where}: no such task file; give one that is there, or a folder for new files")
    where.mkdir(parents=True, exist_ok=True)
    said = list[str]()
    for node, kind in _controllers(tuning).items():
        file = where / f"{node.strip('/').replace('/', '.')}.yaml"
        _write(file, controller_text(_groups(tuning, node, kind), kind))
        said += [str(file), f"  tactile launch {_launched(tuning, node, kind, file)}"]
    for node in _filters(tuning):
        file = where / f"{node.strip('/').replace('/', '.')}.yaml"
        names = [item.name for item in dataclasses.fields(FilterSettings)]
        _write(file, _dump({name: plain(tuning.now[node, name], list) for name in names}))
        said += [str(file), f"  tactile launch .. --filter {file}"]
    if others := _others(tuning):
        file = where / "parameters.yaml"
        _write(file, _dump({node: {"ros__parameters": values} for node, values in others.items()}))
        said += [str(file), f"  ros2 launch tactile_servoing .. params_file:={file}"]
    return said


def controller_text(groups: Groups, kind: str) -> str:
    """A controller file of settings; the group `task` stands below the kind of task, which alone has it."""
    own = {"task": groups["task"]} if "task" in groups else {}
    shared = {group: values for group, values in groups.items() if group not in own}
    return _dump({**shared, **({TASK_GROUPS: {kind: own}} if own else {})})


# ---- which settings belong where ----


def _controllers(tuning: Tuning) -> dict[str, str]:
    """Node -> kind of task, of the controllers with settings that differ and that a file can hold."""
    kinds = {
        node: kind for node in tuning.nodes if (kind := tuning.now.get((node, "task_name"))) in TASKS.names()
    }
    return {node: kind for node, kind in kinds.items() if _groups(tuning, node, kind, only_different=True)}


def _groups(tuning: Tuning, node: str, kind: str, only_different: bool = False) -> Groups:
    names = TASKS.load(kind).settings_class.group_names()
    different, found = tuning.different(), Groups()
    for (owner, name), value in tuning.now.items():
        group, _, key = name.partition(".")
        if owner == node and key and group in names and (not only_different or (node, name) in different):
            found.setdefault(group, {})[key] = plain(value, list)
    return found


def _filters(tuning: Tuning) -> list[str]:
    names = {item.name for item in dataclasses.fields(FilterSettings)}
    return sorted({node for node, name in tuning.different() if name in names and node.endswith("/filter")})


def _others(tuning: Tuning) -> Groups:
    """Node -> parameter -> value, of those that differ and are in no other file."""
    filters, controllers = _filters(tuning), _controllers(tuning)
    found = Groups()
    for (node, name), (_, value) in tuning.different().items():
        kind, group = controllers.get(node, ""), name.partition(".")[0]
        in_controller = bool(kind) and group in TASKS.load(kind).settings_class.group_names()
        in_filter = node in filters and name in {item.name for item in dataclasses.fields(FilterSettings)}
        if not in_controller and not in_filter:
            found.setdefault(node, {})[name] = plain(value, list)
    return found


# ---- tasks ----


def _launched(tuning: Tuning, node: str, kind: str, file: Path) -> str:
    """What to launch with a controller file; what the packaged task sets itself has to be said besides."""
    scene, wanted = _scene(tuning), _groups(tuning, node, kind)
    try:
        task = load_task(task_path(kind), scene)
        name = _role(task, node, kind).name
        chosen = f"{name}={file}" if len(task.roles) > 1 else str(file)
        role = load_task(task_path(kind), scene, controller=chosen).role(name)
    except SettingError:  # it was launched from a task file of somebody's own
        return f".. --controller {file}"
    least = [
        f"--set {shlex.quote(f'{role.name}.{group}.{name}={value_text(value)}')}"
        for group, name, value in _missed(role.settings, wanted)
    ]
    return " ".join([kind, f"--scene {scene}", f"--controller {chosen}", *least])


def _into_task(tuning: Tuning, path: Path) -> list[str]:
    """Write into a task file, the rest of which stays as it is."""
    scene, text = _scene(tuning), path.read_text()
    task, wanted = load_task(path, scene), dict[str, Groups]()
    for node, kind in _controllers(tuning).items():
        groups, role = _groups(tuning, node, kind, only_different=True), _role(task, node, kind).name
        if wanted.setdefault(role, groups) != groups:
            raise SettingError(
                f"{path}: role {role}: its arms have different settings now; a role has one set"
            )
    if not wanted:
        raise SettingError("no setting of a controller differs; a task file holds no others: give a folder")
    on_scene = {name: read_yaml(path).section("scenes").section(scene).section(name) for name in wanted}
    for role, groups in wanted.items():
        there = on_scene[role].section("settings")
        for group, values in groups.items():
            held = there.section(group).values
            of_scene = {name: value for name, value in values.items() if name in held}
            of_role = {name: value for name, value in values.items() if name not in held}
            text = _with(text, ["scenes", scene, role], group, of_scene, path)
            text = _with(text, ["roles", role], group, of_role, path)
    with whole_file(path) as temporary:
        temporary.write_text(text)
        result = load_task(temporary, scene)
        for role, groups in wanted.items():
            for group, name, _ in _missed(result.role(role).settings, groups):
                raise SettingError(f"{path}: {role}.{group}.{name} cannot be set there: edit it by hand")
    return [f"{path}: settings of {', '.join(wanted)}", f"  tactile launch {path} --scene {scene}"]


def _with(text: str, place: list[str], group: str, values: Mapping[str, Any], path: Path) -> str:
    if not values:
        return text
    known = yaml.safe_load(text)
    for key in place:
        known = known[key]
    try:
        if "settings" not in known:
            return with_values(text, place, {"settings": {group: dict(values)}})
        return with_values(text, [*place, "settings", group], values)
    except YamlEditError as error:
        raise SettingError(f"{path}: {error}") from error


def _missed(settings: SettingGroups, wanted: Groups) -> list[tuple[str, str, Any]]:
    """Group, name and value of what settings do not have as it is wanted."""
    pairs = [(group, name, value) for group, values in wanted.items() for name, value in values.items()]
    return [each for each in pairs if getattr(settings.group(each[0]), each[1]) != plain(each[2])]


def _role(task: Task, node: str, kind: str) -> Role:
    arm = node.strip("/").split("/")[0]
    roles = [role for role in task.roles if role.task == kind and (not role.arms or arm in role.arms)]
    if len(roles) != 1:
        names = ", ".join(role.name for role in roles) or "none"
        raise SettingError(f"task {task.name}: roles of task {kind} for {arm}: {names}; one is needed")
    return roles[0]


def _scene(tuning: Tuning) -> str:
    """Name of the scene that the nodes were started with; '' where none says."""
    paths = {str(value) for (_, name), value in tuning.now.items() if name == "scene" and value}
    return Path(min(paths)).stem if paths else ""


def _write(path: Path, text: str) -> None:
    with whole_file(path) as temporary:
        temporary.write_text(text)


def _dump(content: Mapping[str, Any]) -> str:
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)
