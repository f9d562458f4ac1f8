"""The whole graph in one process, on one executor: ``python -m crash_coach_bringup.ros.single``.

Parameters of a node are given as ``-p <node>:<name>:=<value>``; graph.single_process builds the
command line. Only the coach's parameter services run in a thread of their own, as they always do.
"""

from __future__ import annotations

import signal
import sys
from types import FrameType

import rclpy
from rclpy.exceptions import ParameterException
from rclpy.experimental import EventsExecutor
from rclpy.signals import SignalHandlerOptions

from crash_coach_common.contract import UserError
from crash_coach_pkg.ros import coach_node, gate_node
from policy_pkg.ros.team_node import TeamNode
from sim_pkg.ros.sim_lock import SecondSimError, only_sim
from sim_pkg.ros.sim_node import SimNode

SPIN_S = 0.1  # how soon a signal is noticed


def main() -> int:
    """The exit code: 0 after the last episode or a signal, 1 after one line of error."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    try:
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        with only_sim(rclpy.get_default_context().get_domain_id()):
            _run(received)
    except (UserError, ParameterException, SecondSimError) as error:
        print(f"graph: error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    finally:
        rclpy.try_shutdown()
    return 0


def _run(received: list[int]) -> None:
    executor = EventsExecutor()
    gate = gate_node.start(executor)
    coach = coach_node.start(executor)
    team, sim = TeamNode(), SimNode()
    executor.add_node(team)
    executor.add_node(sim)
    try:
        while not received and not sim.done:
            executor.spin_once(timeout_sec=SPIN_S)
            if team.failure is not None:
                raise team.failure
        if sim.failure is not None:
            raise UserError(sim.failure)
        sim.finish()
    finally:
        # In this order: DDS must not call back into what is gone (the executor first lets go).
        executor.shutdown()
        for node in (coach, gate, team, sim):
            node.destroy_node()


if __name__ == "__main__":
    sys.exit(main())
