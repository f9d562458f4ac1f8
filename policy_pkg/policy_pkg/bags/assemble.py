"""One episode's pieces to arrays, and what is missing or contradicts itself."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import BoolArray, FloatArray, IntArray
from policy_pkg.bags.decode import Decodes
from policy_pkg.bags.join import Key, Pieces
from policy_pkg.bags.topics import Kind

UNKNOWN = -1
_SHOWN = 3  # of the missing things


class IncompleteError(ValueError):
    """Something of the episode was not recorded, or has not come yet."""


class ContradictionError(ValueError):
    """What was recorded of the episode cannot be true."""


@dataclass(frozen=True)
class Wanted:
    """What an episode of this bag has to have.

    decisions: one command or withheld-command event for every robot-step, and the action executed
        is the one commanded, as in lock-step.
    effects: an event for every command or observation under a fault.
    seen: what the policies saw is a topic of its own.
    intents: one command_raw for every robot-step. Never decisive: -1 where unknown.
    """

    decisions: bool
    effects: bool
    seen: bool
    intents: bool


@dataclass(frozen=True)
class Joined:
    """An episode of T steps, n robots. Entry T of truth, seen and available is zero where the
    episode terminated: nothing is observed there, and nothing of it counts in training."""

    truth: FloatArray  # (T+1, n, O) observations that the sim published
    seen: FloatArray  # (T+1, n, O) what the policies saw: truth, but for observation faults
    available: BoolArray  # (T+1, n, A)
    state: FloatArray  # (T+1, S)
    reward: npt.NDArray[np.float64]  # (T,)
    executed: IntArray  # (T, n)
    intents: IntArray  # (T, n) UNKNOWN where not recorded
    crashed: BoolArray  # (T, n) some fault was in force
    codes: npt.NDArray[np.uint8]  # (T, n) Action.fault of the command, 0 where there is none
    modes: dict[Key, str]  # names of command faults, from the events
    observed: dict[Key, str]  # names of observation faults, from the events
    end: Any  # EpisodeState


def counts_suffice(pieces: Pieces, n_robots: int, wanted: Wanted) -> bool:
    """A cheap necessary condition for completeness."""
    steps = pieces.end.step
    robot_steps = n_robots * steps
    raw = pieces.raw
    return (
        len(pieces.states) > steps
        and len(raw[Kind.OBSERVATION]) >= robot_steps
        and (not wanted.seen or len(raw[Kind.SEEN]) >= robot_steps)
        and (not wanted.intents or len(raw[Kind.INTENT]) >= robot_steps)
        and (not wanted.decisions or len(raw[Kind.COMMAND]) + len(pieces.effects) >= robot_steps)
    )


def assemble(
    pieces: Pieces, robots: Sequence[str], wanted: Wanted, decoder: Decodes, last: bool
) -> Joined:
    """The episode. ``last``: nothing more will come, so what is not decisive may be missing.

    Raises:
        IncompleteError: what is missing.
        ContradictionError: what is wrong.
    """
    if pieces.conflicts:
        raise ContradictionError("; ".join(list(pieces.conflicts)[:_SHOWN]))
    end = pieces.end
    if end is None:
        raise IncompleteError("it has no end")
    n = len(robots)
    states = _states(pieces, n)
    truth, available = _observations(pieces, Kind.OBSERVATION, robots, decoder)
    seen = _observations(pieces, Kind.SEEN, robots, decoder)[0] if wanted.seen else truth
    if seen.shape != truth.shape:
        raise ContradictionError("observation and observation_seen have different sizes")
    executed = np.array([s.actions for s in states[1:]], np.int32).reshape(-1, n)
    crashed = np.array([s.crashed for s in states[1:]], np.bool_).reshape(-1, n)
    _check_executed(executed, available, robots)
    reward = np.array([s.reward for s in states[1:]], np.float64)
    state = _stacked([s.state for s in states], "EpisodeState.state")
    if not (np.isfinite(reward).all() and np.isfinite(state).all()):
        raise ContradictionError("reward or state holds NaN or infinity")
    decided = _Decisions(pieces, robots, decoder, executed, crashed)
    codes = decided.codes(wanted)
    return Joined(
        truth=truth,
        seen=seen,
        available=available,
        state=state,
        reward=reward,
        executed=executed,
        intents=decided.intents(wanted.intents and not last),
        crashed=crashed,
        codes=codes,
        modes=decided.modes(pieces.effects),
        observed=decided.modes(pieces.observed),
        end=end,
    )


def _states(pieces: Pieces, n: int) -> list[Any]:
    steps = range(pieces.end.step + 1)
    missing = [step for step in steps if step not in pieces.states]
    if missing:
        raise IncompleteError(f"no EpisodeState of step {_some(missing)}")
    states = [pieces.states[step][0] for step in steps]
    for state in states:
        wanted = {"crashed": n, "positions_m": 2 * n, "actions": n if state.step else 0}
        for name, size in wanted.items():
            found = len(getattr(state, name, [0] * size))
            if found != size:
                raise ContradictionError(
                    f"wrong robot count: EpisodeState.{name} of step {state.step} has {found} "
                    f"values where {n} robots are recorded"
                )
        if state.seed != pieces.end.seed:
            raise ContradictionError(
                f"seeds {state.seed} and {pieces.end.seed}: two sims in one bag"
            )
    return states


def _observations(
    pieces: Pieces, kind: Kind, robots: Sequence[str], decoder: Decodes
) -> tuple[FloatArray, BoolArray]:
    """(T+1, n, O) features and (T+1, n, A) availability."""
    steps, raw = pieces.end.step, pieces.raw[kind]
    observed = steps if pieces.end.terminated else steps + 1
    keys = [(step, robot) for step in range(observed) for robot in range(len(robots))]
    _refuse_missing(kind.value, (key for key in keys if key not in raw), robots)
    messages = [decoder.decode(*raw[key]) for key in keys]
    features = _stacked([m.features for m in messages], f"{kind.value}.features")
    actions = _stacked([m.available_actions for m in messages], f"{kind.value}.available_actions")
    if not np.isfinite(features).all():
        step, robot = keys[int(np.flatnonzero(~np.isfinite(features).all(1))[0])]
        raise ContradictionError(f"NaN or infinity in /{robots[robot]}/{kind.value}, step {step}")
    if features.dtype != np.float32 or actions.dtype != np.uint8 or (actions > 1).any():
        raise ContradictionError(f"{kind.value} holds other types or values than defined")
    n = len(robots)
    obs = np.zeros((steps + 1, n, features.shape[1]), np.float32)
    available = np.zeros((steps + 1, n, actions.shape[1]), np.bool_)
    obs[:observed] = features.reshape(observed, n, -1)
    available[:observed] = actions.reshape(observed, n, -1)
    return obs, available


def _stacked(rows: Sequence[npt.NDArray[Any]], name: str) -> npt.NDArray[Any]:
    sizes = {len(row) for row in rows}
    if len(sizes) != 1 or 0 in sizes:
        raise ContradictionError(f"{name} has {sorted(sizes)} values; must be one size above 0")
    return np.stack(rows)


def _check_executed(executed: IntArray, available: BoolArray, robots: Sequence[str]) -> None:
    n_actions = available.shape[2]
    inside = (executed >= 0) & (executed < n_actions)
    allowed = np.take_along_axis(
        available[: len(executed)], np.clip(executed, 0, n_actions - 1)[..., np.newaxis], 2
    )[..., 0]
    wrong = np.argwhere(~(inside & allowed))
    if len(wrong):
        step, robot = (int(value) for value in wrong[0])
        raise ContradictionError(
            f"{robots[robot]} executed action {executed[step, robot]} in step {step}, which was "
            "not available"
        )


class _Decisions:
    """Commands, intents and events of an episode, held against what was executed."""

    def __init__(
        self,
        pieces: Pieces,
        robots: Sequence[str],
        decoder: Decodes,
        executed: IntArray,
        crashed: BoolArray,
    ) -> None:
        self._pieces, self._robots = pieces, robots
        self._executed, self._crashed = executed, crashed
        steps = len(executed)
        self._keys = [(step, robot) for step in range(steps) for robot in range(len(robots))]
        self._commands = self._decoded(Kind.COMMAND, decoder)
        self._intents = self._decoded(Kind.INTENT, decoder)

    def _decoded(self, kind: Kind, decoder: Decodes) -> dict[Key, Any]:
        raw = self._pieces.raw[kind]
        return {key: decoder.decode(*raw[key]) for key in self._keys if key in raw}

    def codes(self, wanted: Wanted) -> npt.NDArray[np.uint8]:
        """(T, n) Action.fault; checks every robot-step."""
        effects, observed = self._pieces.effects, self._pieces.observed
        if wanted.decisions:
            missing = (k for k in self._keys if k not in self._commands and k not in effects)
            _refuse_missing("command or event of a withheld one", missing, self._robots)
        if wanted.effects:
            faulted = (key for key, command in self._commands.items() if command.fault)
            missing = (key for key in faulted if key not in effects and key not in observed)
            _refuse_missing("EFFECT event", missing, self._robots)
        applied = (k for k, e in effects.items() if e.applied >= 0 and k[0] < len(self._executed))
        missing = (key for key in applied if key not in self._commands)
        _refuse_missing("command beside an EFFECT", missing, self._robots)
        codes = np.zeros(self._executed.shape, np.uint8)
        for key in self._keys:
            command = self._commands.get(key)
            problem = self._contradiction(key, command, wanted.decisions)
            if problem is not None:
                raise ContradictionError(f"{self._robots[key[1]]}, step {key[0]}: {problem}")
            codes[key] = command.fault if command is not None else 0
        return codes

    def _contradiction(self, key: Key, command: Any, lockstep: bool) -> str | None:
        effect = self._pieces.effects.get(key)
        applied = effect.applied if effect is not None else None
        if command is None:
            return None
        if applied is not None and applied != command.action:
            given = f"action {command.action}"
            return f"a command with {given}, but an EFFECT that applied {applied}"
        if effect is not None and not command.fault:
            return f"an EFFECT of {effect.mode}, but a command without a fault"
        if not lockstep:
            return None
        if command.action != self._executed[key]:
            return f"commanded action {command.action}, executed {self._executed[key]}"
        if bool(command.fault) != bool(self._crashed[key]):
            return f"a command with fault code {command.fault}, but crashed = {self._crashed[key]}"
        return None

    def intents(self, all_of_them: bool) -> IntArray:
        """(T, n) what the policies wanted."""
        if all_of_them:
            missing = (key for key in self._keys if key not in self._intents)
            _refuse_missing("command_raw", missing, self._robots)
        out = np.full(self._executed.shape, UNKNOWN, np.int32)
        for key in self._keys:
            raw, effect = self._intents.get(key), self._pieces.effects.get(key)
            command = self._commands.get(key)
            if raw is not None:
                out[key] = raw.action
                if effect is not None and effect.intent != raw.action:
                    robot = self._robots[key[1]]
                    raise ContradictionError(
                        f"{robot}, step {key[0]}: intent {raw.action} in command_raw, "
                        f"{effect.intent} in the EFFECT"
                    )
            elif effect is not None:
                out[key] = effect.intent
            elif command is not None and not command.fault:
                out[key] = command.action
        return out

    def modes(self, events: dict[Key, Any]) -> dict[Key, str]:
        """Names of the faults in force, of the steps that were executed."""
        return {k: str(event.mode) for k, event in events.items() if k[0] < len(self._executed)}


def _refuse_missing(what: str, missing: Iterable[Key], robots: Sequence[str]) -> None:
    keys = list(missing)
    if keys:
        some = _some([f"{robots[robot]}'s step {step}" for step, robot in keys])
        raise IncompleteError(f"no {what} of {some}")


def _some(things: Sequence[object]) -> str:
    more = f" and {len(things) - _SHOWN} more" if len(things) > _SHOWN else ""
    return ", ".join(map(str, things[:_SHOWN])) + more
