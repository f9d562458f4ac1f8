"""A team that plays episodes without ROS, and plays them again when robots are crashed in them."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from crash_coach_common.contract import UserError
from crash_coach_console.curves import Curves
from crash_coach_console.episodes import Played
from crash_coach_console.film import Film
from crash_coach_console.operating import joined
from crash_coach_console.requests import Inject
from crash_coach_console.source import Kind
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.injection import describe
from crash_coach_pkg.faults import check_parameters
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import Condition
from policy_pkg.play.evaluate import Evaluation, Scripted, evaluate, evaluation_seed, record
from policy_pkg.play.target import Target
from sim_pkg.env import make_env

EVALUATED = 64
"""Episodes that are played, unseen, to tell what a crash costs."""
CHUNK = 4


@dataclass
class _Tally:
    """How many episodes of a condition were played for the costs."""

    condition: Condition
    modes: tuple[str, ...]
    played: int = 0
    asked: Future[Evaluation] | None = field(default=None, repr=False)


class Player:
    """Episodes that `crash-coach evaluate` plays with ``seed``.

    Raises ConfigError for a scenario that cannot be played.
    """

    kind: Kind = "episodes"

    def __init__(self, target: Target, seed: int = 0) -> None:
        self._target = target
        self._seed = evaluation_seed(seed)
        self._team = target.team
        self._scenario = target.source
        spec = make_env(self._scenario, 1).spec
        self._action_names = spec.action_names
        self._robots = spec.robots
        self._crash = CoachConfig()  # in every episode
        self._tallies: dict[str, _Tally] = {}
        self._threads = ThreadPoolExecutor(1, thread_name_prefix="costs")
        self._curves = Curves(Path(target.name))
        self.title = f"{Path(target.name).name} · {target.scenario}"

    def _film(self, episode: int, crash: CoachConfig) -> Film:
        condition = Condition("console", crash)
        (frames,) = record(
            self._team, self._scenario, condition, range(episode, episode + 1), self._seed
        )
        return Film(frames, self._action_names)

    def first(self) -> Film:
        return self.choose(0)

    def choose(self, episode: int) -> Film:
        return self._film(episode, self._crash)

    def after(self, film: Film) -> Film:
        """Of a run that is still being trained, with its newest checkpoint."""
        if not isinstance(self._team, Scripted):
            self._team = load_policy(Path(self._target.name))
        return self.choose(film.frames.episode + 1)

    def crash(self, film: Film, asked: Inject, frame: int) -> tuple[Film, str]:
        """``now``: this episode from ``frame`` on, or where it is over from its beginning; and the
        next ones from ``start_step`` on."""
        frame = 0 if frame == film.frames.steps else frame
        unknown = [name for name in asked.victims if name not in self._robots]
        if unknown:
            raise UserError(f"unknown robot {unknown[0]!r}; one of: {', '.join(self._robots)}")
        check_parameters(asked.mode, asked.parameters)
        now = asked.apply_at == "next_step"
        try:
            wanted = CoachConfig(
                strategy="fixed",
                victims=asked.victims,
                crash_mode=asked.mode,
                crash_parameters=dict(asked.parameters),
                duration_steps=asked.duration_steps,
            )
        except ValidationError as error:
            raise UserError(error.errors()[0]["msg"]) from None
        crash = joined(self._crash, wanted)
        this = crash.model_copy(update={"start_step": frame}) if now else self._crash
        crashed = self._film(film.frames.episode, this)
        crashed.begin = frame
        later = crash.model_copy(update={"start_step": asked.start_step})
        self._crash = later
        told = describe(crash.victims, asked.mode, asked.apply_at, asked.parameters)
        return crashed, told + (f" (from step {frame} of this episode)" if now else "")

    def clear(self, film: Film, robots: Sequence[str]) -> tuple[Film, str]:
        victims = tuple(name for name in self._crash.victims if robots and name not in robots)
        if victims:
            self._crash = self._crash.model_copy(update={"victims": victims})
        else:
            self._crash = CoachConfig()
        said = f"still crashed: {', '.join(victims)}" if victims else "nobody is crashed any more"
        return self._film(film.frames.episode, self._crash), f"{said}; the episode once more"

    def more(self) -> list[Played]:
        """Further episodes, crash-free and with today's crash, played in the background."""
        for crash in (CoachConfig(), self._crash):
            modes = (crash.crash_mode,) if crash.victims else ()
            key = crash.model_dump_json()
            self._tallies.setdefault(key, _Tally(Condition("console", crash), modes))
        return [played for tally in self._tallies.values() for played in self._advance(tally)]

    def _advance(self, tally: _Tally) -> list[Played]:
        if tally.asked is None:
            if tally.played < EVALUATED:
                episodes = range(tally.played, tally.played + CHUNK)
                tally.asked = self._threads.submit(
                    evaluate, self._team, self._scenario, tally.condition, episodes, self._seed
                )
            return []
        if not tally.asked.done():
            return []
        found = tally.asked.result()
        tally.asked = None
        tally.played += CHUNK
        return [
            Played(
                result.episode,
                tuple(found.robots[i] for i in result.crashed),
                tally.modes if result.crashed else (),
                result.success,
                result.episode_return,
                result.steps,
            )
            for result in found.episodes
        ]

    def pages(self) -> dict[str, dict[str, Any]]:
        return self._curves.pages()
