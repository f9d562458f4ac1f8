"""Gate and coach in front of robots that this project does not simulate, as two processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import check_domain
from crash_coach_bringup.ros.graph import Node, Value, graph_environment, node_process, placed
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_bringup.ros.parameter_file import ParameterFile
from crash_coach_bringup.ros.supervisor import Event, Supervisor, watch
from crash_coach_bringup.ros.up import stop_signals
from crash_coach_common.contract import UserError
from crash_coach_pkg.team import check_robots

LISTEN_S = 0.02
GATE = "gate"
AUTO = "auto"


@dataclass(frozen=True)
class OwnRobots:
    """A team of one's own, and where its commands pass.

    ``command_type``: package/msg/Type, or auto; ``raw_topic``: what its controllers publish on,
    ``command_topic``: what its robots listen to, within each robot's namespace; ``dt_s``: length of
    a step of the faults, seconds, of /clock with ``use_sim_time``. What of these, and of robots, is
    empty or None is what ``params_file`` sets on the gate, or else has its default.

    ``fault_scenario``: a file that decides who crashes; ``namespace``: of every name; empty: none.
    """

    robots: tuple[str, ...] = ()
    command_type: str = ""
    raw_topic: str = ""
    command_topic: str = ""
    dt_s: float | None = None
    use_sim_time: bool = False
    fault_scenario: Path | None = None
    namespace: str = ""
    params_file: Path | None = None
    log_level: str = "info"
    log_dir: Path = Path("runs/gate")

    def of_file(self) -> dict[str, Any]:
        """What the parameter file sets on the gate. Raises UserError as ParameterFile."""
        if self.params_file is None:
            return {}
        return ParameterFile(self.params_file).of(f"{checked_namespace(self.namespace)}/{GATE}")


def own_nodes(team: OwnRobots) -> list[Node]:
    """Gate and coach.

    Raises:
        UserError: no robots, or names that are none; as graph.placed.
    """
    of_file = team.of_file()
    named = team.robots or of_file.get("robots", ())
    if not isinstance(named, list | tuple) or not all(isinstance(name, str) for name in named):
        raise UserError(f"{team.params_file}: robots is {named!r}; a list of names is needed")
    if not named and team.params_file is not None:
        raise UserError(
            f"{team.params_file} names no robots of {checked_namespace(team.namespace)}/{GATE}: "
            f"put them there (under /**/{GATE}, in any namespace), or give them beside the file"
        )
    shared: dict[str, Value] = {"robots": list(check_robots(named))}
    gate: dict[str, Value] = {
        "command_type": team.command_type or of_file.get("command_type", AUTO)
    }
    gate |= {"raw_topic": team.raw_topic} if team.raw_topic else {}
    gate |= {"command_topic": team.command_topic} if team.command_topic else {}
    # The coach counts the gate's steps.
    dt_s = team.dt_s or of_file.get("dt_s")
    shared |= {} if dt_s is None else {"dt_s": dt_s}
    if team.use_sim_time or of_file.get("use_sim_time", False):
        shared["use_sim_time"] = True
    coach: dict[str, Value] = {"follow_sim": False}
    if team.fault_scenario is not None:
        coach["fault_scenario"] = str(team.fault_scenario.resolve())
    nodes = [
        Node(GATE, "crash_coach_pkg", "gate", {**shared, **gate}),
        Node("coach", "crash_coach_pkg", "coach", {**shared, **coach}),
    ]
    return placed(nodes, team.namespace, team.params_file, team.log_level)


def run_own(team: OwnRobots, on_event: Callable[[Event], None]) -> int:
    """Runs gate and coach until one ends or a signal comes; the exit code: 1 after a death, 130.

    ``on_event`` hears what happens as it happens. Call it from the main thread: SIGINT, SIGTERM
    and SIGHUP stop both in order while they run.

    Raises:
        UserError: as own_nodes; an executable that is not installed, or a bad domain.
        OSError: a log cannot be written.
    """
    domain = check_domain(None)
    nodes = own_nodes(team)
    processes = [node_process(node) for node in nodes]
    with (
        stop_signals() as interrupted,
        graph_client("crash_coach_gate", domain, namespace=team.namespace) as client,
        Supervisor(processes, team.log_dir, graph_environment(domain)) as running,
    ):
        for name, pid in running.pids().items():
            on_event(Event("started", name, f"process {pid}, log {running.log_of(name)}"))
        progress = Progress(client, nodes[0], on_event)
        exit_code = watch(running, (), interrupted, on_event, meanwhile=progress.look)
    on_event(Event("stopped", "", f"no process is left on domain {domain}"))
    return exit_code


class Progress:
    """Tells when both are there, and what becomes of each robot's commands, whenever it changes."""

    def __init__(self, client: GraphClient, gate: Node, on_event: Callable[[Event], None]) -> None:
        self._client = client
        self._gate = gate
        self._on_event = on_event
        self._ready = False
        self._said: dict[str, str] = {}
        client.node.create_subscription(DiagnosticArray, "diagnostics", self._on_diagnostics, 10)

    def look(self) -> None:
        """Listens for a moment; call it often."""
        self._client.pause(LISTEN_S)
        node = self._client.node
        if self._ready or not all(
            node.count_publishers(topic) for topic in ("coach/plan", "coach/plan_in_force")
        ):
            return
        self._ready = True
        space, robots = self._gate.namespace, self._gate.parameters["robots"]
        assert isinstance(robots, list)  # as own_nodes says
        option = f" --namespace {space}" if space else ""
        self._on_event(
            Event("ready", "", f"crash-coach inject --victims {robots[0]} --mode mute{option}")
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if not status.name.startswith("gate: "):
                continue
            if self._said.get(status.hardware_id) != status.message:
                self._said[status.hardware_id] = status.message
                self._on_event(Event("robot", "", f"{status.hardware_id}: {status.message}"))
