"""Hands: does what a person asks for beside a running graph, one after the other, in a thread of its own.

With a context of its own, so that an answer that does not come holds up nothing. The emergency stop alone
waits for nobody: it is sent by whoever asks for it.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from tactile_base.raised import told
from tactile_bringup.launching.operator import Operator, OperatorError
from tactile_bringup.tuning import Key, Request, RuntimeSetting, plain, runtime_setting

IDLE = 0.02  # s, between looks while nobody asks: what arms say must not pile up before an answer


class Hands:
    """Acts by the operator, which is then its own, and looks in between.

    `say` gets what came of it, and whether that is good.
    """

    def __init__(
        self,
        operator: Operator,
        say: Callable[[str, bool], None],
        look: Callable[[Operator], None] = Operator.look,
    ) -> None:
        self._say, self._asked, self._look = say, queue.Queue[Callable[[Operator], str] | None](), look
        self._operator = operator
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop_all(self) -> None:
        """Publish /estop at once, from whatever thread."""
        self._operator.stop()

    def ask(self, act: Callable[[Operator], str]) -> None:
        """Have something done with the operator; it returns what is to be said."""
        self._asked.put(act)

    def close(self) -> None:
        """End the thread, once what was asked for is done, and leave the graph."""
        self._asked.put(None)
        self._thread.join()
        self._operator.close()

    def _run(self) -> None:
        while (act := self._next()) is not None:
            try:
                if said := act(self._operator):
                    self._say(said, True)
            except OperatorError as error:
                self._say(str(error), False)
            except Exception as error:  # as of a value that is none at all
                self._say(told(error), False)

    def _next(self) -> Callable[[Operator], str] | None:
        try:
            return self._asked.get(timeout=IDLE)
        except queue.Empty:
            return self._looking

    def _looking(self, operator: Operator) -> str:
        self._look(operator)
        return ""


def settings_of(operator: Operator, node: str) -> list[RuntimeSetting]:
    """All settings of a node, those that are fixed while it runs as well."""
    found = operator.parameters(node)
    return [runtime_setting(node, name, value, about) for name, (value, about) in found.items()]


def carry_out(operator: Operator, request: Request) -> tuple[set[Key], list[str]]:
    """Have nodes take what is asked for, each all or nothing: what is in force now, and refusals in words."""
    taken, refusals = set[Key](), []
    for node, values in request.by_node().items():
        try:
            operator.set_parameters(node, {name: plain(value, list) for name, value in values.items()})
        except OperatorError as error:
            refusals.append(str(error))
        except Exception as error:  # whoever asked waits for what has become of it
            refusals.append(told(error))
        else:
            taken |= {(node, name) for name in values}
    return taken, refusals
