"""Gate and coach in front of robots that this project does not simulate, as two processes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from diagnostic_msgs.msg import DiagnosticArray

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import check_domain
from crash_coach_bringup.ros.graph import Node, Value, graph_environment, node_process
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_bringup.ros.supervisor import Event, Supervisor, watch
from crash_coach_bringup.ros.up import stop_signals
from crash_coach_pkg.coach.config import check_robots

LISTEN_S = 0.02


@dataclass(frozen=True)
class OwnRobots:
    """A team of one's own, and where its commands pass.

    ``command_type``: package/msg/Type, or auto; ``raw_topic``: what its controllers publish on, and
    ``command_topic``: what its robots listen to, within each robot's namespace; ``dt_s``: length of
    a step of the faults, seconds, of /clock with ``use_sim_time``; ``namespace``: of every name;
    empty: none.
    """

    robots: tuple[str, ...]
    command_type: str = "auto"
    raw_topic: str = "cmd_vel_raw"
    command_topic: str = "cmd_vel"
    dt_s: float = 0.1
    use_sim_time: bool = False
    namespace: str = ""
    log_dir: Path = Path("runs/gate")


def own_nodes(team: OwnRobots) -> list[Node]:
    """Gate and coach. Raises UserError for robots' names or a namespace that are none."""
    shared: dict[str, Value] = {
        "robots": list(check_robots(team.robots)),
        "dt_s": team.dt_s,
        "use_sim_time": team.use_sim_time,
    }
    gate: dict[str, Value] = {
        **shared,
        "command_type": team.command_type,
        "raw_topic": team.raw_topic,
        "command_topic": team.command_topic,
    }
    coach: dict[str, Value] = {**shared, "follow_sim": False}
    namespace = checked_namespace(team.namespace)
    nodes = [
        Node("gate", "crash_coach_pkg", "gate", gate),
        Node("coach", "crash_coach_pkg", "coach", coach),
    ]
    return [replace(node, namespace=namespace) for node in nodes]


def run_own(team: OwnRobots, on_event: Callable[[Event], None]) -> int:
    """Runs gate and coach until one ends or a signal comes; the exit code: 1 after a death, 130.

    ``on_event`` hears what happens as it happens. Call it from the main thread: SIGINT, SIGTERM
    and SIGHUP stop both in order while they run.

    Raises:
        UserError: as own_nodes; an executable that is not installed, or a bad domain.
        OSError: a log cannot be written.
    """
    domain = check_domain(None)
    processes = [node_process(node) for node in own_nodes(team)]
    with (
        stop_signals() as interrupted,
        graph_client("crash_coach_gate", domain, namespace=team.namespace) as client,
        Supervisor(processes, team.log_dir, graph_environment(domain)) as running,
    ):
        for name, pid in running.pids().items():
            on_event(Event("started", name, f"process {pid}, log {running.log_of(name)}"))
        progress = Progress(client, team, on_event)
        exit_code = watch(running, (), interrupted, on_event, meanwhile=progress.look)
    on_event(Event("stopped", "", f"no process is left on domain {domain}"))
    return exit_code


class Progress:
    """Tells when both are there, and what becomes of each robot's commands, whenever it changes."""

    def __init__(
        self, client: GraphClient, team: OwnRobots, on_event: Callable[[Event], None]
    ) -> None:
        self._client = client
        self._team = team
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
        space = checked_namespace(self._team.namespace)
        option = f" --namespace {space}" if space else ""
        victim = self._team.robots[0]
        self._on_event(
            Event("ready", "", f"crash-coach inject --victims {victim} --mode mute{option}")
        )

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if not status.name.startswith("gate: "):
                continue
            if self._said.get(status.hardware_id) != status.message:
                self._said[status.hardware_id] = status.message
                self._on_event(Event("robot", "", f"{status.hardware_id}: {status.message}"))
