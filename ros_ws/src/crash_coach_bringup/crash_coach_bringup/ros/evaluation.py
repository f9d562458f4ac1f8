"""Evaluation over ROS: the same episodes as policy_pkg.train.evaluate, played by a real graph."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
from crash_coach_interfaces.msg import EpisodeState
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_srvs.srv import Trigger

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    Layout,
    UpOptions,
    check_team,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from crash_coach_pkg.coach import Coach
from policy_pkg.train.evaluate import Condition, EpisodeResult, Evaluation
from sim_pkg.contract import UserError

START_S = 60.0  # until the sim serves /sim/reset; a cold start compiles the book-keeping
RETRY_S = 0.05
EPISODE_S = 60.0  # one episode; the sim itself gives up sooner where robots do not answer


class EvaluationError(UserError):
    """The graph did not play an episode as planned; the text says which, and what happened."""


def evaluate_via_ros(
    checkpoint: Path,
    scenario: str,
    condition: Condition,
    episodes: int,
    seed: int,
    layout: Layout = "nodes",
    log_dir: Path | None = None,
) -> Evaluation:
    """Plays episodes 0 .. ``episodes`` - 1 in lock-step on a ROS domain of its own.

    Equal arguments give the results of policy_pkg.train.evaluate.evaluate, bit for bit. The
    nodes' logs go to ``log_dir``; None: to a temporary folder that is kept after an error.

    Raises:
        EvaluationError: a node died, or other robots crashed than the plan says.
        WaitError: the graph did not start, or an episode did not end, in time.
        UserError: as graph.check_team, or a condition that this team cannot keep.
    """
    if episodes < 1:
        raise UserError(f"episodes = {episodes}: at least 1 is needed")
    with reserve_domain() as domain, _logs(log_dir) as logs:
        options = UpOptions(
            scenario=scenario,
            checkpoint=checkpoint,
            layout=layout,
            seed=seed,
            autostart=False,
            coach=condition.crash,
            domain=domain,
            log_dir=logs,
        )
        robots = check_team(options)
        try:
            coach = Coach(condition.crash, robots, seed)
        except ValueError as error:
            raise UserError(f"condition {condition.name!r}: {error}") from error
        processes = graph_processes(options, robots)
        with Supervisor(processes, logs, graph_environment(domain), throughput=True) as graph:

            def check() -> None:
                for ended in graph.wait(0.0):
                    raise EvaluationError(ended.describe())

            with graph_client("crash_coach_evaluation", domain, check) as client:
                collector = Collector(client, coach)
                results = tuple(collector.play(episode) for episode in range(episodes))
    return Evaluation(condition.name, robots, seed, results)


@contextmanager
def _logs(log_dir: Path | None) -> Iterator[Path]:
    if log_dir is not None:
        yield log_dir
        return
    folder = Path(tempfile.mkdtemp(prefix="crash_coach_logs_"))
    yield folder
    shutil.rmtree(folder)  # not reached after an error: the log is what explains it


class Collector:
    """Starts episodes through /sim/reset and gathers what /sim/episode says about each."""

    def __init__(self, client: GraphClient, coach: Coach) -> None:
        self._client = client
        self._coach = coach
        self._states: dict[int, EpisodeState] = {}  # of the running episode, by step
        self._episode = -1
        self._last: EpisodeState | None = None
        self._reset = client.node.create_client(Trigger, "/sim/reset")
        qos = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._subscription = client.node.create_subscription(
            EpisodeState, "/sim/episode", self._on_state, qos
        )
        client.greet("/sim", START_S, "the sim to start")
        client.until(self._ready, START_S, "the sim to serve /sim/reset")

    def _ready(self) -> bool:
        publishers: int = self._client.node.count_publishers("/sim/episode")
        return publishers > 0 and self._reset.service_is_ready()

    def _on_state(self, message: EpisodeState) -> None:
        if message.episode != self._episode:
            return
        self._states[message.step] = message
        if message.terminated or message.truncated:
            self._last = message

    def play(self, episode: int) -> EpisodeResult:
        """Plays the sim's next episode, which has to be ``episode``."""
        self._episode, self._last = episode, None
        self._states.clear()
        self._start(episode)
        self._client.until(lambda: self._last is not None, EPISODE_S, f"episode {episode} to end")
        assert self._last is not None
        return self._result(self._last)

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
        return EpisodeResult(
            episode=last.episode,
            success=last.success,
            episode_return=last.episode_return,
            steps=last.step,
            crashed=self._check_crashed(states),
            trajectory_hash=last.trajectory_hash,
        )

    def _check_crashed(self, states: list[EpisodeState]) -> tuple[int, ...]:
        """Holds every robot-step against the coach's plan; returns who the plan faults."""
        plan = self._coach.plan(states[0].episode)
        for state in states[1:]:
            planned = plan.modes_at(state.step - 1, len(self._coach.robots)) != 0
            crashed = np.frombuffer(state.crashed, dtype=np.uint8) != 0
            if not np.array_equal(planned, crashed):
                raise EvaluationError(
                    f"episode {plan.episode}, step {state.step - 1}: the plan crashes "
                    f"{self._names(planned)}, crashed were {self._names(crashed)}"
                )
        return tuple(sorted({fault.robot for fault in plan.faults}))

    def _names(self, mask: npt.NDArray[np.bool_]) -> str:
        robots = self._coach.robots
        return ", ".join(robots[i] for i in np.flatnonzero(mask)) or "nobody"
