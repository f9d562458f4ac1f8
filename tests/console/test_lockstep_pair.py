"""Two teams in lock-step, in a namespace, side by side: the same episodes, crashed alike."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from console_teams import WAIT_S, Asker, asking, console
from crash_coach_interfaces.msg import EpisodeState

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import UpOptions, check_team, graph_environment, graph_processes
from crash_coach_bringup.ros.supervisor import Supervisor
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

SPACE = "fleet_a"

# Two whole graphs; test_page.py has two teams in every run of the suite.
pytestmark = pytest.mark.soak


class Pair:
    """``ends``: of each team, the last state of each episode, by its number."""

    def __init__(self, clients: list[GraphClient], asker: Asker) -> None:
        self.clients, self.ask = clients, asker
        self.ends: list[dict[int, EpisodeState]] = [{}, {}]
        for client, ends in zip(clients, self.ends, strict=True):

            def note(state: EpisodeState, ends: dict[int, EpisodeState] = ends) -> None:
                if state.terminated or state.truncated:
                    ends[state.episode] = state

            client.node.create_subscription(EpisodeState, f"{SPACE}/sim/episode", note, 1000)

    def newest(self) -> int:
        return max((*self.ends[0], *self.ends[1]), default=-1)

    def until_crashed(self, first: list[int], second: list[int]) -> list[EpisodeState]:
        """How the next episode of both ended, once each team's newest has these crashed.

        What the teams were asked may take, and states that wait to be read may be old.
        """
        for client, ends, crashed in zip(self.clients, self.ends, (first, second), strict=True):
            client.until(
                lambda ends=ends, crashed=crashed: (  # type: ignore[misc]
                    bool(ends) and list(ends[max(ends)].crashed) == crashed
                ),
                WAIT_S,
                f"an episode with {crashed} crashed",
            )
        both = self.until_both(self.newest() + 1)
        assert [list(end.crashed) for end in both] == [first, second]
        return both

    def until_both(self, episode: int) -> list[EpisodeState]:
        """How ``episode`` ended for each."""
        for client, ends in zip(self.clients, self.ends, strict=True):
            client.until(
                lambda ends=ends: max(ends, default=-1) >= episode,  # type: ignore[misc]
                WAIT_S,
                f"episode {episode}",
            )
        return [ends[episode] for ends in self.ends]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    folder = tmp_path_factory.mktemp("pair")
    checkpoint = folder / "step_0"
    write_untrained(checkpoint, make_env("buttons", 1).spec, seed=1)
    options = UpOptions(
        "buttons", checkpoint, layout="single", namespace=SPACE, epsilon=1.0,
        sim={"pace_hz": 40.0},
    )  # fmt: skip
    processes = graph_processes(options, check_team(options))
    with ExitStack() as stack:
        domains = [stack.enter_context(reserve_domain()) for _ in range(2)]
        for number, domain in enumerate(domains):
            logs, environment = folder / str(number), graph_environment(domain)
            stack.enter_context(Supervisor(processes, logs, environment))
        clients = [stack.enter_context(graph_client("looker", domain)) for domain in domains]
        asked = ("--domain", *map(str, domains), "--namespace", SPACE)
        environment = {**os.environ, **graph_environment(domains[0])}
        address = stack.enter_context(console(environment, *asked))
        yield Pair(clients, stack.enter_context(asking(address)))


def test_the_same_seed_gives_both_the_same_episodes_also_under_the_same_fault(pair: Pair) -> None:
    first, second = pair.until_both(pair.newest() + 2)
    assert first.trajectory_hash == second.trajectory_hash != ""
    for source in (0, 1):
        answer = pair.ask(
            source=source, type="inject", victims=["robot_1"], mode="mute", apply_at="next_episode"
        )
        assert answer["ok"], answer
    faulted = pair.until_crashed([1, 0], [1, 0])
    assert faulted[0].trajectory_hash == faulted[1].trajectory_hash
    for source in (0, 1):
        answer = pair.ask(source=source, type="clear", robots=[])
        assert answer["ok"], answer
    pair.until_crashed([0, 0], [0, 0])


def test_one_of_them_is_crashed_alone(pair: Pair) -> None:
    answer = pair.ask(source=1, type="inject", victims=["robot_2"], mode="mute")
    assert answer["ok"], answer
    pair.until_crashed([0, 0], [0, 1])
