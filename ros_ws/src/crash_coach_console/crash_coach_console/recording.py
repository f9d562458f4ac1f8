"""A recording (rosbag2) as episodes on a page: played again from seed and executed actions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from crash_coach_common.contract import UserError
from crash_coach_console.episodes import Played
from crash_coach_console.film import Film
from crash_coach_console.requests import Inject
from crash_coach_console.source import Kind
from policy_pkg.bags.bag import Bag, find_bags
from policy_pkg.bags.dataset import BagReading, RecordedEpisode
from policy_pkg.bags.playback import play_back, read_episode
from policy_pkg.bags.problems import BagError, Problem
from sim_pkg.env import make_env


class Recording:
    """Raises BagError where ``path`` is not one recording with a complete episode; UserError where
    its scenario is not known here, or plays otherwise here."""

    kind: Kind = "recording"

    def __init__(self, path: Path, scenario: str | None = None) -> None:
        self.title = path.name
        self._path = path
        recorded, about = read_episode(path, None)
        told = about.scenario if about is not None else ""
        self._scenario = scenario or told
        if not self._scenario:
            raise UserError(f"{path}: the recording does not name its scenario: give --scenario")
        self._action_names = make_env(self._scenario, 1).spec.action_names
        self._first = recorded
        (bag,) = find_bags([path])
        self._index = self._outcomes(bag)

    def _outcomes(self, bag: Bag) -> Iterator[Played]:
        """Of every complete episode, read once from the beginning to the end."""
        ignored: list[Problem] = []
        for recorded in BagReading(bag, ignored.append).episodes():
            ignored.clear()
            yield outcome(recorded)

    def _film(self, recorded: RecordedEpisode) -> Film:
        return Film(play_back(recorded, self._scenario), self._action_names)

    def first(self) -> Film:
        return self._film(self._first)

    def choose(self, episode: int) -> Film:
        return self._film(read_episode(self._path, episode)[0])

    def after(self, film: Film) -> Film:
        number = film.frames.episode + 1
        try:
            return self.choose(number)
        except BagError:
            return self.first()

    def crash(self, film: Film, asked: Inject, frame: int) -> tuple[Film, str]:
        raise UserError("a recording shows what was: nobody can be crashed in it any more")

    def clear(self, film: Film, robots: Sequence[str]) -> tuple[Film, str]:
        raise UserError("a recording shows what was: nothing can be cleared in it any more")

    def more(self) -> list[Played]:
        played = next(self._index, None)
        return [] if played is None else [played]

    def pages(self) -> dict[str, dict[str, Any]]:
        return {}


def outcome(recorded: RecordedEpisode) -> Played:
    """Who was crashed in a recorded episode, and how it ended."""
    robots = sorted({robot for _, robot in recorded.modes})
    return Played(
        recorded.number,
        tuple(recorded.robots[robot] for robot in robots),
        tuple(sorted(set(recorded.modes.values()))),
        recorded.success,
        float(recorded.episode.reward.sum()),
        recorded.episode.length,
    )
