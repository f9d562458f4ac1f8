"""The sim node: a Session behind ROS topics and services, in lock-step or in real time."""

from __future__ import annotations

import time
from contextlib import ExitStack
from enum import Enum

from crash_coach_interfaces.msg import FaultEvent
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_srvs.srv import SetBool, Trigger

from crash_coach_common.contract import UserError
from crash_coach_common.ros.qos_node import QosNode
from crash_coach_common.ros.run_node import run, serving
from crash_coach_common.team_cdr import RobotMessage
from sim_pkg.env import make_env
from sim_pkg.lockstep import Decisions
from sim_pkg.pause import Pause
from sim_pkg.realtime import NewestCommands
from sim_pkg.ros import convert
from sim_pkg.ros.arena_view import ArenaView
from sim_pkg.ros.sim_lock import only_sim
from sim_pkg.ros.sim_params import read_parameters
from sim_pkg.ros.sim_topics import SimTopics
from sim_pkg.session import Session

_POLL_S = 0.05
_HOUSEKEEPING_S = 1.0


class _Phase(Enum):
    MATCHING = "waiting for the robots' publishers and subscribers"
    IDLE = "waiting for /sim/reset"
    RUNNING = "running"
    DONE = "done"


class SimNode(QosNode):
    """See ROS.md and docs/ros.md for the protocol. ``done`` or ``failure`` end the process.

    Raises:
        ConfigError: a parameter or the scenario is wrong.
        SecondSimError: another sim runs on the domain, in the same namespace.
    """

    def __init__(self) -> None:
        super().__init__("sim", start_parameter_services=False)
        self.failure: str | None = None
        self._alone = ExitStack()
        domain = self.context.get_domain_id()
        self._alone.enter_context(only_sim(domain, self.get_namespace()))
        self._params = params = read_parameters(self)
        self._env = env = make_env(params.scenario, 1)
        self._session = Session(env, params.seed, params.first_episode)
        self._lockstep = params.mode == "lockstep"
        self._decisions = Decisions(env.spec.robots)
        period_s = env.spec.dt_s / params.real_time_factor
        self._newest = NewestCommands(env.spec.robots, params.cmd_timeout_s or 3 * period_s)
        self._phase = _Phase.MATCHING
        self._succeeded = 0  # episodes
        self._pause = Pause(period_s, time.monotonic)
        self._robot_indexes = {name: i for i, name in enumerate(env.spec.robots)}
        arena = ArenaView(self, env, self._lockstep, params.arena_hz, time.monotonic)
        self._topics = SimTopics(
            self,
            arena,
            env.spec,
            params.seed,
            self._on_commands,
            self._on_error,
            self._on_event,
            self._lockstep,
        )
        self.create_service(Trigger, "sim/reset", self._on_reset)
        self.create_service(Trigger, "sim/step", self._on_step)
        self.create_service(SetBool, "sim/pause", self._on_pause)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._born_s = self._sent_s = time.monotonic()
        self._match_timer = self._every(_POLL_S, self._poll_match)
        self._every(_HOUSEKEEPING_S, self._housekeeping)
        if self._lockstep:
            self._every(params.resend_after_s / 2, self._resend)
            if params.pace_hz:
                self._every(1 / params.pace_hz, self._advance_if_complete)
        else:
            self._every(period_s, self._tick)

    @property
    def done(self) -> bool:
        """The wanted number of episodes has ended, or something failed."""
        return self._phase is _Phase.DONE or self.failure is not None

    def destroy_node(self) -> None:
        super().destroy_node()
        self._alone.close()

    def finish(self) -> None:
        """Leaves no reader without the last episode state."""
        self._topics.flush()

    def _every(self, period_s: float, callback):  # type: ignore[no-untyped-def]
        return self.create_timer(period_s, callback, clock=self._steady)

    # --- start ------------------------------------------------------------------------------

    def _poll_match(self) -> None:
        """Starts once every robot is there; gives up in bounded time."""
        waited_s = time.monotonic() - self._born_s
        missing = self._topics.unmatched()
        if missing and waited_s > self._params.match_timeout_s:
            text = f"after {self._params.match_timeout_s:g} s still: {'; '.join(missing)}"
            if self._lockstep:
                self.failure = text
                return
            self.get_logger().warning(f"{text}; starting without them")
        elif missing:
            return
        self._match_timer.cancel()
        self._topics.refresh_listeners()
        self._phase = _Phase.IDLE
        starts = "" if self._params.autostart else "; /sim/reset starts each episode"
        self.get_logger().info(f"ready: {self._params.scenario}, {self._params.mode}{starts}")
        if self._params.autostart:
            self._begin()

    def _begin(self) -> None:
        self._session.begin()
        self._phase = _Phase.RUNNING
        self._newest.open(self._session.episode)
        self._open_step()

    def _open_step(self) -> None:
        """Awaits commands for the session's step, then says that it awaits them."""
        session = self._session
        if self._lockstep:
            self._decisions.open(session.episode, session.step, session.stay(), session.available)
        else:
            self._newest.observed(session.step)
        self._sent_s = time.monotonic()
        self._topics.publish_step(session)

    # --- stepping ---------------------------------------------------------------------------

    def _on_error(self, error: UserError) -> None:
        self._fail(str(error))

    def _on_commands(self, messages: list[RobotMessage]) -> None:
        for robot, data in messages:
            self._on_command(robot, data)

    def _on_command(self, robot: int, data: bytes) -> None:
        try:
            message = convert.command_from_bytes(data)
        except UserError as error:
            self._fail(f"{self._env.spec.robots[robot]}: {error}")
            return
        if not self._lockstep:
            self._newest.command(
                robot,
                message.episode,
                message.step,
                message.action,
                message.fault,
                self._pause.now_s(),
            )
            return
        try:
            counts = self._decisions.command(
                robot, message.episode, message.step, message.action, message.fault
            )
        except ValueError as error:
            self._fail(str(error))
            return
        if counts:
            self._decided()

    def _on_event(self, event: FaultEvent) -> None:
        robot = self._robot_indexes.get(event.robot)
        if robot is None or not convert.is_mute(event):
            return
        if not self._lockstep:
            self._newest.mute(robot, event.episode, self._pause.now_s())
        elif self._decisions.mute(robot, event.episode, event.step):
            self._decided()

    def _decided(self) -> None:
        """Lock-step: one robot more is; with ``pace_hz`` a timer looks whether all are."""
        if not self._params.pace_hz:
            self._advance_if_complete()

    def _advance_if_complete(self) -> None:
        if self._decisions.complete and self._pause.may_step():
            self._advance(self._decisions)

    def _tick(self) -> None:
        """Real time: a control step is due."""
        if self._phase is not _Phase.RUNNING or not self._pause.may_step():
            return
        session = self._session
        refused = self._newest.sample(session.stay(), session.available, self._pause.now_s())
        for text in refused:
            self.get_logger().warning(f"refused: {text}")
        self._advance(self._newest)

    def _advance(self, decided: Decisions | NewestCommands) -> None:
        self._session.advance(decided.actions, decided.crashed)
        if self._session.running:
            self._open_step()
        else:
            self._close_episode()

    def _close_episode(self) -> None:
        """Publishes the end and starts what comes next."""
        self._decisions.close()
        self._topics.publish_step(self._session)
        self._succeeded += self._session.success
        if self._session.begun == self._params.episodes:
            self._phase = _Phase.DONE
            self.get_logger().info(
                f"{self._session.begun} episodes are over: {self._succeeded} successes"
            )
        elif self._params.autostart:
            self._begin()
        else:
            self._phase = _Phase.IDLE

    def _resend(self) -> None:
        """Lock-step: an observation or its answer may have been lost."""
        if time.monotonic() - self._sent_s < self._params.resend_after_s:
            return
        try:
            silent = self._decisions.resend(self._params.max_resends)
        except TimeoutError as error:
            self._fail(str(error))
            return
        self._sent_s = time.monotonic()
        self._topics.observe_again(silent)

    def _fail(self, text: str) -> None:
        """Ends the episode loudly: readers see it cut short, the process exits with an error."""
        self.failure = "; ".join(filter(None, (text, self._topics.rivals())))
        self._decisions.close()
        if self._session.running:
            self._session.cut()
            self._topics.publish_step(self._session)

    def _housekeeping(self) -> None:
        self._topics.refresh_listeners()
        decided = self._decisions if self._lockstep else self._newest
        self._topics.publish_diagnostics(decided, self._session)
        self._topics.catch_up(self._session)

    # --- services ---------------------------------------------------------------------------

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._phase in (_Phase.MATCHING, _Phase.DONE):
            response.message = f"cannot reset: {self._phase.value}"
            return response
        self._pause.forget()
        if self._session.running:
            self._session.cut()
            self._close_episode()
        if self._phase is _Phase.IDLE:
            self._begin()
        response.success = self._phase is _Phase.RUNNING
        running = f"episode {self._session.episode} runs"
        response.message = running if response.success else "that was the last episode"
        return response

    def _on_step(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not self._pause.on or self._phase is not _Phase.RUNNING:
            state = self._phase.value if self._phase is not _Phase.RUNNING else "not paused"
            response.message = f"cannot step: {state}"
            return response
        response.success = True
        response.message = f"step {self._session.step} of episode {self._session.episode}"
        self._pause.grant()
        if self._lockstep:
            self._advance_if_complete()
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._pause.set(request.data)
        response.success = True
        response.message = "paused" if request.data else "running on"
        if not request.data and self._lockstep:
            self._advance_if_complete()
        return response


def _run(received: list[int]) -> None:
    """Serves a sim until it is done or stopped. Raises UserError saying why it failed."""
    with serving() as served:
        node = served.add(SimNode())
        served.until(lambda: received or node.done)
        if node.done:  # who is told to end does not wait for readers, some of which may be dead
            node.finish()
    if node.failure is not None:
        raise UserError(node.failure)


def main() -> int:
    """Entry point of ``ros2 run sim_pkg sim``; exit code 0 at the end or on a signal, else 1."""
    return run(_run, "sim")
