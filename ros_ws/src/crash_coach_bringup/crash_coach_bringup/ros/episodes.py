"""The episodes of a running graph, as they end: who was crashed, and how they went."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from rclpy.serialization import deserialize_message

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_common.ros.qos import EVENTS, EVERY_EPISODE
from crash_coach_console.episodes import Costs, EpisodeBook, Played
from crash_coach_console.ros.convert import event_kind

LISTEN_S = 0.02
REST_S = 5.0  # at most, after the graph's end


class Episodes:
    """Listens on a graph; ``costs`` has the episodes told so far."""

    def __init__(self, client: GraphClient) -> None:
        self.costs = Costs()
        self._client = client
        self._book = EpisodeBook()
        self._heard = 0  # messages
        sub = client.node.create_subscription
        # Latched: the first episode may begin before this node is known to the sim.
        sub(EpisodeState, "sim/boundary", self._on_boundary, EVERY_EPISODE)
        sub(FaultEvent, "coach/events", self._on_event, EVENTS, raw=True)

    def told(self, wait_s: float = LISTEN_S) -> Iterator[Played]:
        """Listens for so long; gives what is settled."""
        self._client.pause(wait_s)
        yield from self._give(self._book.settled(time.monotonic()))

    def rest(self) -> Iterator[Played]:
        """At the end, once nothing more comes: on a busy machine much may wait to be heard."""
        end_s, heard = time.monotonic() + REST_S, -1
        while heard != self._heard and time.monotonic() < end_s:
            heard = self._heard
            self._client.pause(LISTEN_S)
        yield from self._give(self._book.settled(time.monotonic(), 0.0))

    def _give(self, found: Iterator[Played]) -> Iterator[Played]:
        for played in found:
            self.costs.add(played)
            yield played

    def _on_boundary(self, state: EpisodeState) -> None:
        self._heard += 1
        if state.terminated or state.truncated:
            now_s = time.monotonic()
            self._book.end(state.episode, state.success, state.episode_return, state.step, now_s)
        else:
            self._book.begin(state.episode)

    def _on_event(self, data: bytes) -> None:
        self._heard += 1
        # There is an EFFECT for every faulted robot-step; where faults begin, an ACTIVE tells it.
        if event_kind(data) == FaultEvent.ACTIVE:
            event = deserialize_message(data, FaultEvent)
            self._book.faulted(event.episode, event.robot, event.mode)


@contextmanager
def listening(domain: int, namespace: str = "") -> Iterator[Episodes]:
    """On the graph of a domain, in a namespace."""
    with graph_client("crash_coach_episodes", domain, namespace=namespace) as client:
        yield Episodes(client)


def summary_lines(costs: Costs) -> list[str]:
    """A line for each row of ``Costs.rows``."""
    lines = []
    for row in costs.rows():
        who = row["crashed"]
        if who is None:
            name = "all episodes"
        elif isinstance(who, int):
            name = f"{who} crashed"
        else:
            victims = f"{', '.join(who)} ({', '.join(row['modes'])})" if who else "nobody"
            name = f"{victims} crashed"
        rate, low, high = (100 * x for x in row["success"])
        interval = "all ended alike" if row["alike"] else f"{low:.1f}..{high:.1f}"
        many = "1 episode" if row["episodes"] == 1 else f"{row['episodes']} episodes"
        lines.append(
            f"{name}: {many}, success {rate:.1f} % ({interval}), return {row['return'][0]:.2f}, "
            f"{row['steps']:.1f} steps"
        )
    return lines
