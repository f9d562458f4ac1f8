"""The whole graph in one process, on one executor: ``python -m crash_coach_bringup.ros.single``.

Parameters of a node are given as ``-p <node>:<name>:=<value>``; graph.single_process builds the
command line. Only the coach's parameter services run in a thread of their own, as they always do.
"""

from __future__ import annotations

import sys

from crash_coach_common.contract import UserError
from crash_coach_common.ros.run_node import run, serving
from crash_coach_pkg.ros import coach_node, gate_node
from policy_pkg.ros.team_node import TeamNode
from sim_pkg.ros.sim_node import SimNode


def main() -> int:
    """The exit code: 0 after the last episode or a signal, 1 after one line of error."""
    return run(_run, "graph")


def _run(received: list[int]) -> None:
    with serving() as served:
        served.start(gate_node.start)
        served.start(coach_node.start)
        team, sim = served.add(TeamNode()), served.add(SimNode())

        def done() -> object:
            if team.failure is not None:
                raise team.failure
            return received or sim.done

        served.until(done)
        if sim.failure is not None:
            raise UserError(sim.failure)
        sim.finish()


if __name__ == "__main__":
    sys.exit(main())
