"""What a running graph says about the episodes that it plays, held against their plans."""

from __future__ import annotations

import time
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from crash_coach_interfaces.msg import EpisodeState, FaultEvent
from std_srvs.srv import Trigger

from crash_coach_bringup.ros.client import GraphClient
from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos import EVENTS, EVERY_EPISODE
from crash_coach_pkg.effects import EffectKind, EffectRow
from crash_coach_pkg.plan import Planner
from crash_coach_pkg.schedule import Schedule, World
from policy_pkg.play.evaluate import EpisodeResult
from sim_pkg.trajectory import CourseHash

START_S = 60.0  # until the sim serves /sim/reset; a cold start compiles the book-keeping
RETRY_S = 0.05
EPISODE_S = 60.0  # one episode; the sim itself gives up sooner where robots do not answer
EVENTS_S = 10.0  # until the last events of an episode are there
_KINDS: dict[int, EffectKind] = {
    FaultEvent.ACTIVE: "ACTIVE",
    FaultEvent.CLEARED: "CLEARED",
    FaultEvent.EFFECT: "EFFECT",
}


class EvaluationError(UserError):
    """The graph did not play an episode as planned; the text says which, and what happened."""


class Collector:
    """Starts episodes through /sim/reset and gathers what /sim/episode says about each.

    Args:
        planner: plans what the graph's coach plans.
    """

    def __init__(self, client: GraphClient, planner: Planner, robots: tuple[str, ...]) -> None:
        self._client = client
        self._planner = planner
        self._robots = robots
        self._states: dict[int, EpisodeState] = {}  # of the running episode, by step
        self._episode = -1
        self._last: EpisodeState | None = None
        # A withheld command is told again where the sim asks again: a set.
        self._effects: set[EffectRow] = set()
        self._faulted: set[tuple[int, int, str]] = set()  # (episode, step, robot) with an EFFECT
        self._refused = ""
        node = client.node
        self._reset = node.create_client(Trigger, "sim/reset")
        self._subscriptions = (
            node.create_subscription(EpisodeState, "sim/episode", self._on_state, EVERY_EPISODE),
            node.create_subscription(FaultEvent, "coach/events", self._on_event, EVENTS),
        )
        client.greet("sim", START_S, "the sim to start")
        client.greet("gate", START_S, "the gate to start")
        client.until(self._ready, START_S, "the sim to serve /sim/reset")

    def _ready(self) -> bool:
        publishers: int = self._client.node.count_publishers("sim/episode")
        return publishers > 0 and self._reset.service_is_ready()

    def _on_state(self, message: EpisodeState) -> None:
        if message.episode != self._episode:
            return
        self._states[message.step] = message
        if message.terminated or message.truncated:
            self._last = message

    def _on_event(self, message: FaultEvent) -> None:
        if message.kind == FaultEvent.REFUSED:
            self._refused = message.detail
        if message.kind not in _KINDS or not message.robot:
            return
        kind = _KINDS[message.kind]
        self._effects.add(
            EffectRow(
                message.episode,
                message.step,
                kind,
                message.robot,
                message.mode,
                message.entry,
                message.intent,
                message.applied,
            )
        )
        if kind == "EFFECT":
            self._faulted.add((message.episode, message.step, message.robot))

    def play(self, episode: int) -> EpisodeResult:
        """Plays the sim's next episode, which has to be ``episode``."""
        self._episode, self._last = episode, None
        self._states.clear()
        self._start(episode)
        self._client.until(self._over, EPISODE_S, f"episode {episode} to end")
        assert self._last is not None
        return self._result(self._last)

    def _over(self) -> bool:
        if self._refused:
            raise EvaluationError(f"episode {self._episode}: plan refused: {self._refused}")
        return self._last is not None

    def effects(self) -> tuple[EffectRow, ...]:
        """Of all episodes that were played, sorted."""
        # The gate's answer comes behind the events that it has published.
        self._client.greet("gate", EVENTS_S, "the gate's last events")
        return tuple(sorted(self._effects))

    def _start(self, episode: int) -> None:
        """Asks for the episode until the sim, which first looks for its robots, begins it."""
        deadline = time.monotonic() + START_S
        what = f"/sim/reset before episode {episode}"
        while True:
            future = self._reset.call_async(Trigger.Request())
            answer = self._client.result(future, START_S, what)
            if answer.success:
                return
            if time.monotonic() > deadline:
                raise EvaluationError(f"{what}: {answer.message}")
            self._client.pause(RETRY_S)

    def _result(self, last: EpisodeState) -> EpisodeResult:
        missing = [step for step in range(last.step + 1) if step not in self._states]
        if missing:
            raise EvaluationError(f"episode {last.episode}: no state of steps {missing} arrived")
        states = [self._states[step] for step in range(last.step + 1)]
        crashed = np.array([np.frombuffer(s.crashed, dtype=np.uint8) != 0 for s in states[1:]])
        self._check_crashed(states, crashed)
        self._check_effects(last.episode, crashed)
        return EpisodeResult(
            episode=last.episode,
            success=last.success,
            episode_return=last.episode_return,
            steps=last.step,
            crashed=tuple(np.flatnonzero(crashed.any(axis=0)).tolist()),
            trajectory_hash=last.trajectory_hash,
            course_hash=_course_hash(states),
        )

    def _check_crashed(self, states: list[EpisodeState], crashed: npt.NDArray[np.bool_]) -> None:
        """Holds every robot-step, (T, n), against the plan."""
        plan = self._planner.plan(states[0].episode)
        schedule = Schedule(plan)
        for step, state in enumerate(states[:-1]):
            positions_m = np.asarray(state.positions_m, dtype=np.float32).reshape(-1, 2)
            schedule.enter(step, World(positions_m, state.episode_return))
            planned = np.zeros(len(self._robots), dtype=np.bool_)
            planned[[plan.faults[place].robot for place in schedule.in_force]] = True
            if not np.array_equal(planned, crashed[step]):
                raise EvaluationError(
                    f"episode {plan.episode}, step {step}: the plan crashes "
                    f"{self._names(planned)}, crashed were {self._names(crashed[step])}"
                )

    def _check_effects(self, episode: int, crashed: npt.NDArray[np.bool_]) -> None:
        """Waits until an EFFECT is there for every robot-step that crashed, and for no other."""
        expected = {
            (episode, int(step), self._robots[robot]) for step, robot in np.argwhere(crashed)
        }
        self._client.until(
            lambda: expected <= self._faulted, EVENTS_S, f"the effects of episode {episode}"
        )
        surplus = sorted(key for key in self._faulted - expected if key[0] == episode)
        if surplus:
            _, step, robot = surplus[0]
            raise EvaluationError(
                f"episode {episode}, step {step}: an effect on {robot}, which did not crash"
            )

    def _names(self, mask: npt.NDArray[np.bool_]) -> str:
        return ", ".join(self._robots[i] for i in np.flatnonzero(mask)) or "nobody"


def _course_hash(states: list[EpisodeState]) -> str:
    """As policy_pkg.play.evaluate makes it, of all states of an episode."""
    course = CourseHash()
    for before, after in pairwise(states):
        course.observe(np.asarray(before.state, dtype=np.float32))
        course.act(np.asarray(after.actions, dtype=np.int32), after.reward)
    return course.finish(states[-1].success)
