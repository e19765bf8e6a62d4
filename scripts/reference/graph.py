"""Pages of the ROS graph: nodes with their parameters, topics, messages."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

from settings import PACKAGES, place_of
from text import code, table

from tactile_base import node_topics, topics

MESSAGES = Path(__file__).parents[2] / "tactile_msgs"
QUOTES = "'\""
NODES = """# Nodes

Started by `ros2 run tactile_servoing NAME`. `tactile get /arm/NAME` shows the parameters of one that runs.

## Every node

"""
LAUNCH = """# Launch files

`ros2 launch tactile_servoing FILE ARGUMENT:=VALUE`. A launch file of a task has the task's name, such as
`surface_following.launch.py`; `servoing.launch.py` starts one arm's nodes within a launch of your own.
"""
TOPICS = """# Topics

Below the arm's namespace, unless they begin with `/`. Quality of service: `reliable`; `latched`, where late
subscribers get the last message; `sensor`, which is best effort.

"""


def nodes_page() -> str:
    """Each node's parameters, topics, services and actions."""
    text = NODES + parameters_of(PACKAGES / "tactile_ros/managed_node.py")
    text += part_text(node_topics.EVERY_NODE)
    for source in sorted((PACKAGES / "tactile_ros/nodes").glob("*_node.py")):
        name = source.stem.removesuffix("_node")
        summary = (ast.get_docstring(ast.parse(source.read_text())) or "").partition("\n")[0]
        text += f"\n## {name}\n\n{summary}\n\n{parameters_of(source)}"
        if part := node_topics.NODES.get(name):
            text += part_text(part)
    return text


def parameters_of(source: Path) -> str:
    """The parameters that a module declares: single ones, and settings classes under their prefix."""
    tree, rows = ast.parse(source.read_text()), []
    for call in calls(tree, "declare_read_only"):
        if isinstance(call.args[1], ast.Constant):
            default, doc = (ast.unparse(argument) for argument in call.args[2:4])
            rows.append((f"`{call.args[1].value}`", f"{doc.strip(QUOTES)}; default `{default}`", "no"))
    for call in calls(tree, "SettingsParameters", "fixed_settings"):
        kind = ast.unparse(call.args[1]).removesuffix("()")
        given = {word.arg: word.value for word in call.keywords}
        prefix = given.get("prefix", call.args[2] if len(call.args) > 2 else None)
        names = "*" if prefix is None else ast.unparse(prefix).lstrip("f").strip(QUOTES) + ".*"
        rows.append((f"`{names}`", f"[{kind}]({place_of(kind)})", changes(call, given)))
    if any(calls(tree, "GroupParameters")):
        rows.append(("`GROUP.NAME`", "[settings of the task](tasks.md)", "yes"))
    return table("parameter | meaning | can be set while the node runs", rows)


def changes(call: ast.Call, given: dict[str | None, ast.expr]) -> str:
    """Whether the parameters of a call can be set while the node runs, in words."""
    if getattr(call.func, "id", "") == "fixed_settings":
        return "no"
    fixed = given.get("read_only")
    if isinstance(fixed, ast.Tuple):
        return "yes, except " + ", ".join(code(ast.literal_eval(item)) for item in fixed.elts)
    return "yes" if fixed is None else "no"


def calls(tree: ast.AST, *names: str) -> Iterator[ast.Call]:
    """Calls of functions of these names, in the order of the source."""
    found = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    yield from sorted((c for c in found if getattr(c.func, "id", "") in names), key=lambda c: c.lineno)


def part_text(part: node_topics.Part) -> str:
    """What a node publishes, hears, serves and does, as a list."""
    kinds = {
        "publishes": part.publishes, "publishes, of each arm": part.publishes_all,
        "subscribes to": part.hears, "subscribes to, of each arm": part.hears_all,
        "services": part.serves, "actions": part.does,
    }  # fmt: skip
    names = {what: [code(getattr(item, "name", item)) for item in items] for what, items in kinds.items()}
    lines = [f"- {what}: {', '.join(items)}" for what, items in names.items() if items]
    return "\n" + "\n".join(lines) + "\n" if lines else ""


def topics_page() -> str:
    """Every topic, with who publishes and who hears it."""
    rows = []
    for topic in [item for item in vars(topics).values() if isinstance(item, topics.Topic)]:
        hears = [name for name, part in node_topics.NODES.items() if topic in part.hears + part.hears_all]
        rows.append((code(topic.name), topic.type, topic.qos, topic.publisher, ", ".join(hears)))
    return TOPICS + table("topic | type | quality of service | published by | heard by", rows)


def launch_page() -> str:
    """The arguments of the launch files, whose module cannot be imported without a ROS 2 install."""
    source = (PACKAGES / "tactile_bringup/launching/launch_description.py").read_text()
    tables = [
        node
        for node in ast.parse(source).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]).endswith("ARGUMENTS")
    ]
    values: dict[str, dict[str, tuple[str, str]]] = {}
    exec(compile(ast.Module(tables, []), source, "exec"), values)  # type: ignore[arg-type]
    text = LAUNCH
    for heading, name in (
        ("Tasks", "ARGUMENTS"),
        ("servoing.launch.py", "SERVOING_ARGUMENTS"),
    ):
        rows = [(f"`{key}`", code(default), meaning) for key, (default, meaning) in values[name].items()]
        text += f"\n## {heading}\n\n" + table("argument | default | meaning", rows)
    return text


def messages_page() -> str:
    """The definitions of our messages, services and actions."""
    text = "# Messages, services and actions\n"
    for path in sorted(MESSAGES.glob("*/*.*")):
        if path.suffix in (".msg", ".srv", ".action"):
            text += f"\n## tactile_msgs/{path.parent.name}/{path.stem}\n\n"
            text += f"```text\n{path.read_text().strip()}\n```\n"
    return text
