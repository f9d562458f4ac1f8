"""One episode as a page shows it: what is drawn, who was faulted how, what was wanted and done."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any

from crash_coach_console.arena import arena_of, state_of
from crash_coach_console.episodes import Played
from crash_coach_console.team import FAULTED, KEPT_STEPS, OK
from crash_coach_pkg.effects import WITHHELD
from crash_coach_pkg.faults import fault_mode, mode_names
from sim_pkg.render.frames import Frames


class Film:
    """Of ``frames``; ``action_names`` as of the scenario."""

    def __init__(self, frames: Frames, action_names: tuple[str, ...]) -> None:
        self.frames = frames
        self.begin = 0  # the frame that it is shown from
        self._action_names = action_names
        self._names = {fault_mode(name).code: name for name in mode_names()}
        self.robots = tuple(actor.name for actor in frames.actors[: frames.n_robots])

    def arena(self) -> dict[str, Any]:
        return arena_of(self.frames, self._action_names).value()

    def state(self, frame: int) -> dict[str, Any]:
        return state_of(self.frames, frame).value()

    @property
    def played(self) -> Played:
        frames = self.frames
        crashed = tuple(self.robots[i] for i in frames.faulted)
        modes = tuple(sorted({stretch["mode"] for stretch in self.stretches}))
        return Played(
            frames.episode,
            crashed,
            modes,
            frames.success,
            float(frames.returns[-1]),
            frames.steps,
        )

    @cached_property
    def stretches(self) -> list[dict[str, Any]]:
        """JSON values: each fault with its robot, mode, first frame and the one after its last."""
        return list(self._stretches())

    def _stretches(self) -> Iterator[dict[str, Any]]:
        for robot, name in enumerate(self.robots):
            codes = [*self.frames.faults[:, robot].tolist(), 0]
            start, before = 0, 0
            for step, code in enumerate(codes):
                if code != before:
                    if before:
                        mode = self._mode(before)
                        yield {"robot": name, "mode": mode, "from": start, "to": step}
                    start, before = step, code

    def _mode(self, code: int) -> str:
        return self._names.get(code, "crashed") if code else ""

    def team(self, frame: int) -> dict[str, Any]:
        """As ``LiveTeam.value``, for the frame after so many steps."""
        codes = self.frames.faults[frame - 1].tolist() if frame else [0] * len(self.robots)
        return {
            "rate": None,
            "revision": None,
            "robots": [
                {
                    "name": name,
                    "state": FAULTED if codes[robot] else OK,
                    "mode": self._mode(codes[robot]),
                    "words": "",
                    "planned": [],
                    "steps": self._steps(robot, frame),
                }
                for robot, name in enumerate(self.robots)
            ],
        }

    def _steps(self, robot: int, frame: int) -> list[list[Any]]:
        frames = self.frames
        rows = []
        for step in range(max(0, frame - KEPT_STEPS), frame):
            mode = self._mode(int(frames.faults[step, robot]))
            action = WITHHELD if mode == "mute" else int(frames.actions[step, robot])
            rows.append([frames.episode, step, int(frames.intents[step, robot]), action, mode])
        return rows
