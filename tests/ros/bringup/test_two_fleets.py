"""Two fleets on one domain, each in a namespace, each crashed alone: ours, and one of Twist."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import pytest
from coach_graph import process
from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from geometry_msgs.msg import Twist
from rclpy.clock import Clock, ClockType

from crash_coach_bringup.ros.client import GraphClient, WaitError, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import UpOptions, check_team, graph_environment, graph_processes
from crash_coach_bringup.ros.inject import clear, inject
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_common.contract import UserError
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env
from sim_pkg.ros.sim_lock import SecondSimError, only_sim

WAIT_S = 60.0
OURS, TWISTS = "fleet_a", "fleet_b"
ROVERS = ("robot_1", "robot_2")  # the same names: only the namespace tells them from ours
OF_ROS = ("/rosout", "/parameter_events")


@dataclass
class Fleets:
    client: GraphClient
    domain: int
    states: list[EpisodeState] = field(default_factory=list)
    events: dict[str, list[FaultEvent]] = field(default_factory=lambda: {OURS: [], TWISTS: []})

    def until_faulted(self, fleet: str, robot: str) -> None:
        def seen() -> bool:
            return any(e.kind == FaultEvent.EFFECT and e.robot == robot for e in self.events[fleet])

        self.client.until(seen, WAIT_S, f"effects on {robot} of {fleet}")

    def faulted(self, fleet: str) -> set[str]:
        return {e.robot for e in self.events[fleet] if e.kind == FaultEvent.EFFECT}

    def crashed(self) -> set[tuple[int, ...]]:
        """In our fleet's next whole episode."""
        # The gate's answer comes behind its events; states that wait to be read may be older.
        self.client.greet(f"{OURS}/gate", WAIT_S, "the gate's events")
        armed = [e.episode for e in self.events[OURS] if e.kind == FaultEvent.ARMED]
        wanted = max(armed[-1] if armed else 0, self.states[-1].episode) + 1
        self.client.until(
            lambda: self.states[-1].episode > wanted, WAIT_S, f"episode {wanted} to end"
        )
        return {tuple(s.crashed) for s in self.states if s.episode == wanted and s.step > 0}


@pytest.fixture(scope="module")
def fleets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleets]:
    folder = tmp_path_factory.mktemp("fleets")
    checkpoint = folder / "step_0"
    write_untrained(checkpoint, make_env("buttons", 1).spec, seed=1)
    pace = {"pace_hz": 50.0}
    options = UpOptions("buttons", checkpoint, layout="team", namespace=OURS, sim=pace)
    processes = graph_processes(options, check_team(options))
    with pytest.MonkeyPatch.context() as patch, ExitStack() as stack:
        domain = stack.enter_context(reserve_domain())
        env = graph_environment(domain)
        for name, value in env.items():
            patch.setenv(name, value)
        stack.enter_context(Supervisor(processes, folder, env))
        rules = (f"__ns:=/{TWISTS}",)
        twist = {"command_type": "geometry_msgs/msg/Twist", "dt_s": 0.05}
        stack.enter_context(process(dict(os.environ), "gate", rules=rules, robots=ROVERS, **twist))
        stack.enter_context(
            process(dict(os.environ), "coach", rules=rules, robots=ROVERS, follow_sim=False)
        )
        client = stack.enter_context(graph_client("looker", domain))
        yield watch(Fleets(client, domain))


def watch(fleets: Fleets) -> Fleets:
    """Drives the rovers, and hears both fleets."""
    node = fleets.client.node
    node.create_subscription(EpisodeState, f"{OURS}/sim/episode", fleets.states.append, 1000)
    for fleet, events in fleets.events.items():
        node.create_subscription(FaultEvent, f"{fleet}/coach/events", events.append, 1000)
    raws = [node.create_publisher(Twist, f"{TWISTS}/{name}/cmd_vel_raw", 10) for name in ROVERS]
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    node.create_timer(0.05, lambda: [raw.publish(Twist()) for raw in raws], clock=steady)
    fleets.client.until(lambda: len(fleets.states) > 0, WAIT_S, "a control step")
    for fleet in (OURS, TWISTS):
        fleets.client.greet(f"{fleet}/coach", WAIT_S, f"the coach of {fleet}")
        fleets.client.greet(f"{fleet}/gate", WAIT_S, f"the gate of {fleet}")
    return fleets


def test_each_is_crashed_alone(fleets: Fleets) -> None:
    assert fleets.crashed() == {(0, 0)}
    inject(("robot_2",), "mute", domain=fleets.domain, namespace=OURS)
    fleets.until_faulted(OURS, "robot_2")
    assert fleets.crashed() == {(0, 1)}
    assert not fleets.faulted(TWISTS)
    clear(domain=fleets.domain, namespace=OURS)
    assert fleets.crashed() == {(0, 0)}

    inject(("robot_1",), "mute", domain=fleets.domain, namespace=f"/{TWISTS}/")
    fleets.until_faulted(TWISTS, "robot_1")
    assert fleets.crashed() == {(0, 0)}
    assert (fleets.faulted(OURS), fleets.faulted(TWISTS)) == ({"robot_2"}, {"robot_1"})
    clear(domain=fleets.domain, namespace=TWISTS)


def test_nothing_lies_outside_the_namespaces(fleets: Fleets) -> None:
    names = [name for name, _ in fleets.client.node.get_topic_names_and_types()]
    names += [name for name, _ in fleets.client.node.get_service_names_and_types()]
    inside = (f"/{OURS}/", f"/{TWISTS}/", "/looker/")
    assert [name for name in names if not name.startswith((*inside, *OF_ROS))] == []
    nodes = {
        f"{space}/{name}" for name, space in fleets.client.node.get_node_names_and_namespaces()
    }
    visible = {name for name in nodes if "/_" not in name}
    ours = {f"/{OURS}/{name}" for name in ("sim", "team", "gate", "coach")}
    assert visible == ours | {f"/{TWISTS}/gate", f"/{TWISTS}/coach", "//looker"}


def test_without_its_namespace_a_coach_is_not_found(fleets: Fleets) -> None:
    text = f"a node /nowhere/coach on ROS domain {fleets.domain}"
    with pytest.raises(WaitError, match=text):
        inject(("robot_1",), "mute", timeout_s=0.3, domain=fleets.domain, namespace="nowhere")


def test_one_sim_for_each_namespace(fleets: Fleets) -> None:
    with only_sim(fleets.domain), only_sim(fleets.domain, "/other"):
        for namespace in (f"/{OURS}", "/", "/other"):
            with pytest.raises(SecondSimError), only_sim(fleets.domain, namespace):
                pass


@pytest.mark.parametrize(
    ("text", "expected"), [("", ""), ("/", ""), ("a", "/a"), ("/a/b_2/", "/a/b_2")]
)
def test_namespaces_as_people_write_them(text: str, expected: str) -> None:
    assert checked_namespace(text) == expected


@pytest.mark.parametrize("text", ["2a", "a b", "a//b", "a-b", "~"])
def test_what_is_no_namespace_is_named(text: str) -> None:
    with pytest.raises(UserError, match="is no ROS namespace"):
        checked_namespace(text)
