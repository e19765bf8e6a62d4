"""The last lines of a node's log are what it did last, not what a library says of the interpreter's end."""

import pytest

SIM = "tactile_ros.nodes.sim_node"


@pytest.mark.parametrize("how", ["asked to end", "ended by an error"])
def test_a_node_with_an_arm_leaves_no_remarks_of_libraries(graph, how):
    code = "import sys\nfrom tactile_ros.nodes import sim_node\n"
    if how == "ended by an error":
        code += (
            "from tactile_sim.cell import Cell\nstep, count = Cell.step, []\n"
            "def steps(self):\n    count.append(1)\n    return step(self) if len(count) < 300 else 1 / 0\n"
            "Cell.step = steps\n"
        )
    asked, program = how == "asked to end", code + "sys.exit(sim_node.main())\n"
    process = graph.start_code(SIM, program, {"scene": "plane"}, wait=asked)
    if asked:
        assert graph.stop(SIM) == 0
    else:
        assert graph.wait(lambda: process.poll() is not None) and process.returncode == 1
        assert "ended by an error: ZeroDivisionError: division by zero (" in graph.log(SIM).read_text()
    assert "nanobind" not in graph.log(SIM).read_text()
