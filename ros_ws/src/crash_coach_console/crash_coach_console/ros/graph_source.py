"""A live graph as a source: what its topics say, and the coach's parameters as buttons."""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from typing import Any

from crash_coach_interfaces.msg import Arena, ArenaState, CrashPlan, EpisodeState, FaultEvent
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import GetParameters, SetParametersAtomically
from std_srvs.srv import SetBool, Trigger

from crash_coach_common.contract import UserError
from crash_coach_console.board import Board
from crash_coach_console.episodes import Costs, EpisodeBook
from crash_coach_console.fleet import Fleet
from crash_coach_console.operating import (
    WATCHED,
    OperatorError,
    settings_value,
    victims_left,
    with_others,
)
from crash_coach_console.requests import (
    Clear,
    Forget,
    Inject,
    Pause,
    Request,
    Reset,
    StepOnce,
)
from crash_coach_console.ros import convert
from crash_coach_console.ros.graph_link import GraphLink
from crash_coach_console.ros.guardian import Guardian
from crash_coach_console.source import Kind
from crash_coach_console.team import LiveTeam
from crash_coach_pkg.coach.injection import describe, injection
from crash_coach_pkg.coach.parameters import Value

POLL_S = 1.0
SHOW_S = 0.2
"""How often a team's state is posted at most."""
DRAW_S = 1 / 30
SILENT_S = 3.5


class GraphSource:
    """The graph on ``domain`` (None: the environment's) under ``namespace``.

    ``ends_faults``: every fault is cleared after ``close``, or when this process is killed.
    """

    kind: Kind = "graph"

    def __init__(
        self,
        number: int,
        title: str = "",
        domain: int | None = None,
        namespace: str = "",
        ends_faults: bool = False,
    ) -> None:
        self.board = Board(number)
        self.domain = int(os.environ.get("ROS_DOMAIN_ID") or 0) if domain is None else domain
        self.namespace = namespace
        self.ends_faults = ends_faults
        self._title = title
        self._guardian: Guardian | None = None
        self._link = GraphLink(self, domain, namespace)
        self._team = LiveTeam()
        self._book = EpisodeBook()
        self._costs = Costs()
        self._values: dict[str, Value] = {}
        self._heard_s = {"sim": -1e9, "coach": -1e9, "gate": -1e9}
        self._asked_s = self._shown_s = self._drawn_s = -1e9
        self._arena = False  # whether our sim has told its own
        self._fleet = Fleet(())
        self._status: Mapping[str, Any] = {}
        self._paused = False
        self._busy = asyncio.Lock()

    @property
    def title(self) -> str:
        where = f"domain {self.domain}" + (f", {self.namespace}" if self.namespace else "")
        return self._title or where

    def start(self) -> None:
        self._link.start()
        if self.ends_faults:
            self._guardian = Guardian(self.domain, self.namespace)

    def close(self) -> None:
        """Raises UserError where faults should have ended and no coach said that they did."""
        self._link.stop()
        if self._guardian is not None:
            self._guardian.close()

    # --- what the graph says (on the link's thread) ---------------------------------------------

    def on_arena(self, message: Arena) -> None:
        try:
            arena = convert.arena_from_message(message)
        except UserError as error:
            self.on_problem(str(error))
            return
        self._arena, self._fleet = True, Fleet(())
        self._link.follow(())
        self._team.name(arena.robots)
        self.board.post("arena", arena.value())

    def on_state(self, message: ArenaState) -> None:
        self._heard_s["sim"] = time.monotonic()
        self._team.executed(message.episode, message.step, message.actions)
        self.board.post("state", convert.state_from_message(message).value())

    def on_boundary(self, message: EpisodeState) -> None:
        now_s = self._heard_s["sim"] = time.monotonic()
        if message.step == 0 and not (message.terminated or message.truncated):
            self._book.begin(message.episode)
            self._team.episode(message.episode)
        else:
            self._book.end(
                message.episode, message.success, message.episode_return, message.step, now_s
            )

    def on_event(self, message: FaultEvent) -> None:
        kind = message.kind
        if kind == FaultEvent.EFFECT:
            self._book.faulted(message.episode, message.robot, message.mode)
            key = (message.episode, message.step)
            self._team.effect(message.robot, message.mode, key, message.intent, message.applied)
            return
        if kind == FaultEvent.ACTIVE:
            self._book.faulted(message.episode, message.robot, message.mode)
            self._team.active(message.robot, message.mode, message.episode)
        elif kind in (FaultEvent.CLEARED, FaultEvent.EXPIRED):
            self._team.cleared(message.robot)
        self.board.log({"at_s": time.time(), **convert.event_value(message)})

    def on_plan(self, message: CrashPlan) -> None:
        self._heard_s["coach"] = time.monotonic()
        self._team.plan(convert.plan_from_message(message))

    def on_plan_in_force(self, message: CrashPlan) -> None:
        self._team.in_force(convert.plan_from_message(message))

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        lines = [convert.diagnosis(status) for status in message.status]
        self._list([line[1] for line in lines if line is not None and line[0] == "gate"])
        for found in lines:
            if found is not None:
                self._heard_s[found[0]] = time.monotonic()
                self._team.diagnosed(*found)

    def on_odometry(self, robot: str, message: Odometry) -> None:
        pose, stamp = message.pose.pose, message.header.stamp
        place = (pose.position.x, pose.position.y, convert.yaw_rad(pose.orientation))
        self._fleet.told(robot, place, convert.seconds(stamp))

    def _list(self, robots: Sequence[str]) -> None:
        """A team without our sim, as its gate or its coach names it."""
        if not self._arena and robots and tuple(robots) != self._fleet.robots:
            self._team.name(robots)
            self._fleet = Fleet(robots)
            self._link.follow(robots)

    def _show_fleet(self) -> None:
        if self._fleet.grown and self._fleet.moved:
            self.board.post("arena", self._fleet.arena().value())
        if self._fleet.moved:
            self.board.post("state", self._fleet.state(self._team.crashed).value())

    def on_problem(self, text: str) -> None:
        event = {"kind": "problem", "episode": 0, "step": None, "robot": "", "mode": ""}
        self.board.log({"at_s": time.time(), "revision": 0, **event, "detail": text})

    def on_tick(self, now_s: float) -> None:
        for played in self._book.settled(now_s):
            self._costs.add(played)
            self._post_costs()
        if now_s - self._drawn_s >= DRAW_S:
            self._drawn_s = now_s
            self._show_fleet()
        if now_s - self._shown_s >= SHOW_S:
            self._shown_s = now_s
            if self._team.changed:
                self.board.post("team", self._team.value())
            self._post_status(now_s)
        if now_s - self._asked_s >= POLL_S and self._link.ready("get"):
            self._asked_s = now_s
            self._ask()

    def _ask(self) -> None:
        """Reads the coach's parameters; also what makes sure that the coach knows this node."""
        asked = self._link.call("get", GetParameters.Request(names=list(WATCHED)))
        asked.add_done_callback(self._on_answer)

    def _on_answer(self, asked: Future[Any]) -> None:
        if asked.exception() is None:  # otherwise the coach is gone, or busy: it is asked again
            self._show(asked.result())

    def _show(self, answer: GetParameters.Response) -> None:
        values = read_values(answer)
        robots = values.get("robots")
        if isinstance(robots, tuple):
            self._list([str(name) for name in robots])
        if values and values != self._values:
            self._values = values
            self.board.post("coach", {"settings": settings_value(values)})

    def _post_costs(self) -> None:
        self.board.post("costs", {"rows": self._costs.rows()})

    def _post_status(self, now_s: float) -> None:
        status = {
            "title": self.title,
            "alive": {who: now_s - heard < SILENT_S for who, heard in self._heard_s.items()},
            "ready": bool(self._values),
            "paused": self._paused,
            "ends_faults": self.ends_faults,
        }
        if status != self._status:
            self._status = status
            self.board.post("status", status)

    # --- what pages ask for (on the server's loop) ----------------------------------------------

    async def act(self, request: Request) -> str:
        async with self._busy:  # a change reads what is set before it sets
            match request:
                case Inject():
                    return await self._inject(request)
                case Clear():
                    return await self._clear(request.robots)
                case Pause():
                    return await self._pause(request.on)
                case StepOnce(by=1):
                    return await self._trigger("step")
                case Reset():
                    return await self._trigger("reset")
                case Forget():
                    self._link.run(self._forget)
                    return "episodes are counted anew"
        raise UserError(f"{request.type}: a live graph cannot do that")

    def _forget(self) -> None:
        self._costs.forget()
        self._post_costs()

    async def _call(self, service: str, request: Any) -> Any:
        try:
            return await asyncio.wrap_future(self._link.call(service, request))
        except TimeoutError as error:
            raise UserError(f"{self.title}: {error}") from None

    async def _settings(self) -> dict[str, Value]:
        """What the coach's parameters are now."""
        if not self._values:
            raise OperatorError(
                f"no coach answers on {self.title}: start one with 'crash-coach up'"
            )
        answer = await self._call("get", GetParameters.Request(names=list(WATCHED)))
        self._link.run(lambda: self._show(answer))
        return read_values(answer)

    async def _set(self, values: Mapping[str, Value]) -> str:
        """Returns the coach's words: since when the change is armed, or nothing."""
        request = SetParametersAtomically.Request(
            parameters=[convert.parameter_message(name, value) for name, value in values.items()]
        )
        result = (await self._call("set", request)).result
        self._asked_s = -1e9  # show what holds now
        if not result.successful:
            raise OperatorError(f"refused: {result.reason}")
        return str(result.reason)

    async def _inject(self, asked: Inject) -> str:
        wanted = injection(
            asked.victims,
            asked.mode,
            asked.apply_at,
            asked.start_step,
            asked.duration_steps,
            asked.parameters,
        )
        wanted = with_others(wanted, await self._settings())
        since = await self._set(wanted)
        victims = wanted["victims"]
        assert isinstance(victims, Sequence)
        told = describe([str(v) for v in victims], asked.mode, asked.apply_at, asked.parameters)
        return f"{told} ({since})" if since else told

    async def _clear(self, robots: Sequence[str]) -> str:
        left = victims_left(robots, await self._settings())
        if not left:
            return await self._trigger("clear_all")
        await self._set({"victims": left, "apply_at": "next_step"})
        return f"{', '.join(robots)}: cleared; still crashed: {', '.join(left)}"

    async def _pause(self, on: bool) -> str:
        answer = await self._call("pause", SetBool.Request(data=on))
        self._paused = on
        return str(answer.message)

    async def _trigger(self, service: str) -> str:
        answer = await self._call(service, Trigger.Request())
        self._asked_s = -1e9
        if not answer.success:
            raise OperatorError(str(answer.message))
        return str(answer.message)


def read_values(answer: GetParameters.Response) -> dict[str, Value]:
    """Of WATCHED; empty where it answers another question: the coach is another version's."""
    if len(answer.values) != len(WATCHED):
        return {}
    found = map(convert.value_from_message, answer.values)
    return {name: v for name, v in zip(WATCHED, found, strict=True) if v is not None}
