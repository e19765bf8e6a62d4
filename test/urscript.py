"""URScript programs, run one time step of the controller after another.

Understood is what the programs are made of that clients upload: functions, threads, `if`, `while`, globals,
critical sections, poses, and the functions that the controller offers. A program becomes Python: every
function a generator, which yields where its thread has used up the time step. Sections are those of "The
URScript Programming Language".
"""

import ast
import re
from collections.abc import Callable, Generator, Mapping
from inspect import isgenerator
from itertools import count
from typing import Any

MOST_CALLS = 20_000  # in a time step: more is a loop that never waits, which the controller ends, too
# Words of Python that are mere names here.
_PYTHONS = {"as", "async", "class", "del", "for", "from", "in", "is", "lambda", "try", "with"}
_FUNCTION = re.compile(r"(?:def|thread) (\w+)\((.*)\):")


class Thread:
    """A thread of a program; `kill` ends it, and `speed_thrd == 0` is false for it."""

    def __init__(self, steps: Generator):
        self.steps, self.alive = steps, True

    def step(self) -> None:
        """Run until the thread waits for its next time step."""
        try:
            next(self.steps)
        except StopIteration:
            self.alive = False


class Program:
    """A program as it arrived, with the functions that the controller offers; both wait by generators.

    Raises
    ------
    ValueError
        If it is not a program: the controller would say "syntax error" and run nothing.
    """

    def __init__(self, text: str, offered: Mapping[str, Callable]):
        python, main = python_of(text)
        try:
            tree = _Calls().visit(ast.parse(python))
        except SyntaxError as error:
            raise ValueError(f"line {error.lineno}: {error.text}") from error
        self._offered, self._calls = offered, count()
        self._names: dict[str, Any] = {"_call": self._call, "_run": self._run, "_kill": self._kill}
        before = set(self._names)
        exec(compile(ast.fix_missing_locations(tree), "urscript", "exec"), self._names)
        self._functions = {name: self._names[name] for name in set(self._names) - before - {"__builtins__"}}
        self._main = Thread(self._functions[main]())
        self._threads = [self._main]

    def step(self) -> bool:
        """Run a time step of every thread, the main one first; false once that one has ended."""
        self._calls = count()
        for thread in list(self._threads):
            if thread.alive:  # one before it may have killed it
                thread.step()
        self._threads = [thread for thread in self._threads if thread.alive]
        return self._main.alive

    def _call(self, name: str, *values: Any, **named: Any) -> Generator:
        if next(self._calls) > MOST_CALLS:
            raise RuntimeError("a loop that never waits")
        known = self._functions.get(name) or self._offered.get(name)
        if known is None:
            raise NameError(f"{name} is no function of this controller")
        result = known(*values, **named)
        return (yield from result) if isgenerator(result) else result

    def _run(self, name: str) -> Thread:
        self._threads.append(Thread(self._functions[name]()))
        return self._threads[-1]

    def _kill(self, thread: Any) -> None:
        # Clients kill threads that they have not started, whose handle is still 0, and go on.
        if isinstance(thread, Thread):
            thread.alive = False


class _Calls(ast.NodeTransformer):
    """Have every call wait for what it calls: a step of the caller ends where one of the callee does."""

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        assert isinstance(node.func, ast.Name)
        if node.func.id.startswith("_"):
            return node
        named = ast.Name("_call", ast.Load())
        return ast.YieldFrom(ast.Call(named, [ast.Constant(node.func.id), *node.args], node.keywords))


def python_of(text: str) -> tuple[str, str]:
    """Python functions for a program, and the name of that which is run."""
    lines = _lines(text)
    shared = [found[1] for line in lines if (found := re.match(r"global (\w+)", line))]
    main, blocks = "", []
    done: list[str] = []
    opened: list[list[str]] = []  # functions stand inside the program, which is one itself
    for line in lines:
        found = _FUNCTION.match(line)
        if found:
            main = main or found[1]
            blocks.append("def")
            opened.append(_opening(found[1], found[2], shared))
        elif not blocks:
            raise ValueError(f"outside of any function: {line}")
        elif line == "end":
            if blocks.pop() == "def":
                done += opened.pop()
        else:
            depth = len(blocks) - max(i for i, kind in enumerate(blocks) if kind == "def")
            middle = line.startswith(("elif ", "else:"))
            opened[-1].append("    " * (depth - middle) + line.removeprefix("global "))
            if line.endswith(":"):
                opened[-1].append("    " * (depth + 1 - middle) + "pass")  # there may be nothing else
                blocks += [] if middle else ["block"]
    if blocks:
        raise ValueError("an end is missing")
    return "\n".join(done) + "\n", main


def _lines(text: str) -> list[str]:
    """Statements, in the words of Python and without comments."""
    text = re.sub(r'("[^"\n]*")|#.*', lambda found: found[1] or "", text)  # a # in a string is no comment
    # Line ends mean nothing to URScript: a value may stand on the line after its "=", and the next statement
    # after that value.
    text = re.sub(r"=[ \t]*\n\s*(-?[\d.]+)[ \t]+(?=\S)", r"= \1\n", text)
    parts = re.split(r'("[^"\n]*")', text)
    text = "".join(part if i % 2 else _words(part) for i, part in enumerate(parts))
    return [line.strip() for line in text.splitlines() if line.strip()]


def _opening(name: str, parameters: str, shared: list[str]) -> list[str]:
    """How a function begins; a name that is global anywhere is so everywhere (section Scoping rules)."""
    own = re.findall(r"\w+", parameters)
    others = sorted({*shared} - {*own})
    begin = [f"def {name}({parameters}):", "    if False: yield"]  # a generator, even if it never waits
    return [*begin, f"    global {', '.join(others)}"] if others else begin


def _words(part: str) -> str:
    """Words of URScript in Python's."""
    part = re.sub(r"\b(enter|exit)_critical\b", "pass", part)  # threads wait nowhere but at a time step's end
    part = re.sub(r"\bkill (\w+)", r"_kill(\1)", part)
    part = re.sub(r"\brun (\w+)\(\)", r'_run("\1")', part)
    part = re.sub(r"\bp\[([^\[\]]*,[^\[\]]*)\]", r"[\1]", part)
    return re.sub(r"\b\w+\b", lambda word: word[0] + "_" * (word[0] in _PYTHONS), part)
