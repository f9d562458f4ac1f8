"""The injection client against a running graph: what it sets counts, what is wrong is refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from crash_coach_interfaces.msg import EpisodeState, FaultEvent

from crash_coach_bringup.ros.client import GraphClient, WaitError, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import UpOptions, check_team, graph_environment, graph_processes
from crash_coach_bringup.ros.inject import InjectError, InjectResult, clear, inject
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_common.contract import UserError
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

WAIT_S = 60.0
PACE_HZ = 60.0


@dataclass(frozen=True)
class Graph:
    """A lock-step graph that plays episode after episode."""

    client: GraphClient
    domain: int

    def episodes(self, count: int) -> list[EpisodeState]:
        """The states of the next ``count`` whole episodes; a new reader gets no old ones."""
        states: list[EpisodeState] = []
        node = self.client.node
        reader = node.create_subscription(EpisodeState, "/sim/episode", states.append, 1000)
        self.client.until(lambda: len(states) > 0, WAIT_S, "a control step")
        first = states[-1].episode + 1
        self.client.until(lambda: states[-1].episode >= first + count, WAIT_S, f"{count} episodes")
        node.destroy_subscription(reader)
        return [s for s in states if first <= s.episode < first + count]


@pytest.fixture(scope="module")
def untouched(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    folder = tmp_path_factory.mktemp("graph")
    checkpoint = folder / "step_0"
    write_untrained(checkpoint, make_env("buttons", 1).spec, seed=1)
    # A pace leaves the processor to what is tested, and to other tests.
    options = UpOptions("buttons", checkpoint, layout="team", sim={"pace_hz": PACE_HZ})
    processes = graph_processes(options, check_team(options))
    with (
        reserve_domain() as domain,
        Supervisor(processes, folder, graph_environment(domain)) as supervisor,
    ):

        def check() -> None:
            for ended in supervisor.wait(0.0):
                raise AssertionError(ended.describe())

        with graph_client("looker", domain, check) as client:
            yield Graph(client, domain)


@pytest.fixture
def graph(untouched: Graph) -> Iterator[Graph]:
    """For tests that inject something."""
    yield untouched
    clear(domain=untouched.domain)
    assert crashed(untouched.episodes(1)) == {(0, 0)}


def crashed(states: list[EpisodeState]) -> set[tuple[int, ...]]:
    """Who was crashed in the steps that led to these states."""
    return {tuple(state.crashed) for state in states if state.step > 0}


def test_a_robot_is_muted_from_the_very_next_step_and_cleared(graph: Graph) -> None:
    assert crashed(graph.episodes(1)) == {(0, 0)}
    states: list[EpisodeState] = []
    events: list[FaultEvent] = []
    node = graph.client.node
    readers = [
        node.create_subscription(EpisodeState, "/sim/episode", states.append, 1000),
        node.create_subscription(FaultEvent, "/coach/events", events.append, 1000),
    ]
    graph.client.until(lambda: len(states) > 0, WAIT_S, "a control step")
    result = inject(("robot_1",), "mute", domain=graph.domain)
    assert result == InjectResult(("robot_1",), "mute", "next_step", 0, 0)
    assert str(result) == "robot_1: mute from the next step on"
    graph.client.pause(0.5)
    effects = [e for e in events if e.kind == FaultEvent.EFFECT]
    assert {(e.robot, e.mode, e.applied) for e in effects} == {("robot_1", "mute", -1)}
    first = effects[0]
    (armed,) = [e for e in events if e.kind == FaultEvent.ARMED and e.revision == first.revision]
    assert (first.episode, first.step) == (armed.episode, armed.step)
    for state in states:
        faulted = (state.episode, state.step) > (armed.episode, armed.step)
        assert state.step == 0 or tuple(state.crashed) == ((1, 0) if faulted else (0, 0))
    for reader in readers:
        node.destroy_subscription(reader)
    assert clear(domain=graph.domain) == "every fault is cleared; enabled is now false"
    assert crashed(graph.episodes(2)) == {(0, 0)}


def test_from_the_next_episode_on(graph: Graph) -> None:
    inject(("robot_2",), "random", apply_at="next_episode", domain=graph.domain)
    assert crashed(graph.episodes(2)) == {(0, 1)}


def test_a_part_of_each_episode(graph: Graph) -> None:
    options = {"apply_at": "next_episode", "start_step": 2, "duration_steps": 3}
    inject(("robot_1", "robot_2"), "mute", domain=graph.domain, **options)  # type: ignore[arg-type]
    for state in graph.episodes(2):
        if state.step > 0:
            assert tuple(state.crashed) == ((1, 1) if 2 <= state.step - 1 < 5 else (0, 0))


def test_what_is_wrong_is_refused_whole(untouched: Graph) -> None:
    for victims, mode, apply_at, duration, reason in (
        (("robot_9",), "mute", "next_step", 0, "unknown robot 'robot_9'.*robot_1, robot_2"),
        (("robot_1", "robot_1"), "mute", "next_step", 0, "robot_1 more than once"),
        (("robot_1",), "mute", "now", 0, "apply_at 'now'.*'next_step'"),
        (("robot_1",), "mute", "next_step", -1, "duration_steps"),
    ):
        with pytest.raises(InjectError, match=f"the coach refused: .*{reason}"):
            inject(victims, mode, apply_at, duration, domain=untouched.domain)
        assert crashed(untouched.episodes(1)) == {(0, 0)}


def test_a_mode_with_parameters_instead_of_what_was_set_before(graph: Graph) -> None:
    inject(("robot_1",), "delay", "next_episode", domain=graph.domain, parameters={"steps": 900})
    result = inject(
        ("robot_2",), "delay", "next_episode", domain=graph.domain, parameters={"steps": 2}
    )
    assert result.parameters == {"steps": 2}
    assert str(result) == "robot_2: delay (steps 2) from the next episode on"
    events: list[FaultEvent] = []
    node = graph.client.node
    reader = node.create_subscription(FaultEvent, "/coach/events", events.append, 1000)
    states = graph.episodes(2)
    node.destroy_subscription(reader)
    assert crashed(states) == {(0, 1)}
    effects = {
        (e.episode, e.step): e
        for e in events
        if e.kind == FaultEvent.EFFECT and e.episode == states[0].episode
    }
    assert [effects[states[0].episode, step].applied for step in (0, 1)] == [-1, -1]
    assert {(e.robot, e.mode) for e in effects.values()} == {("robot_2", "delay")}
    late = [effects[key].applied for key in sorted(effects)]
    intents = [effects[key].intent for key in sorted(effects)]
    # What is not available any more two steps later is not passed on.
    pairs = list(zip(late[2:], intents[:-2], strict=True))
    assert pairs
    assert all(applied in (intent, -1) for applied, intent in pairs)


def test_unknown_modes_and_parameters_are_named() -> None:
    with pytest.raises(UserError, match=r"unknown crash mode 'explode'; one of: mute, random"):
        inject(("robot_1",), "explode")
    with pytest.raises(UserError, match=r"delay: no parameter 'stps' .did you mean 'steps'"):
        inject(("robot_1",), "delay", parameters={"stps": 1})


def test_what_the_gate_cannot_do_is_refused_with_its_reason(untouched: Graph) -> None:
    # By the coach, or by the gate where the coach does not know its topics yet.
    reason = r"the coach refused: the gate (would refuse|refused): .*observations"
    with pytest.raises(InjectError, match=reason):
        inject(("robot_1",), "blind", domain=untouched.domain)
    assert crashed(untouched.episodes(1)) == {(0, 0)}


def test_nobody_is_not_a_victim() -> None:
    with pytest.raises(UserError, match="name at least one robot"):
        inject((), "mute")


def test_a_domain_without_a_coach_is_named(ros_env: dict[str, str], tmp_path: Path) -> None:
    text = f"waited 0.3 s for a node /coach on ROS domain {ros_env['ROS_DOMAIN_ID']}"
    with pytest.raises(WaitError, match=text):
        inject(("robot_1",), "mute", timeout_s=0.3)
    with pytest.raises(WaitError, match=text):
        clear(timeout_s=0.3)
