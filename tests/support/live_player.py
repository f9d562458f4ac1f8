"""Plays the tasks of live training in this process, as a graph in lock-step would."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_pkg.coach.coach import Coach
from crash_coach_pkg.coach.strategies.base import Progress
from crash_coach_pkg.plan import CrashPlan
from crash_coach_pkg.team import TeamSpec
from policy_pkg.agent import Sensed
from policy_pkg.bags.dataset import RecordedEpisode
from policy_pkg.episode import Episode
from policy_pkg.live_weights import LiveAgent, Weights
from policy_pkg.train.config import TrainConfig, graph_seed
from policy_pkg.train.live.order import Lockstep, Task
from policy_pkg.train.live.run import LiveRun
from policy_pkg.train.live.session import LiveSession
from policy_pkg.train.metrics import Value
from sim_pkg.env import Env, make_env
from sim_pkg.session import Session as Sim

SPEC = make_env("buttons", 1).spec
SMALL: dict[str, Any] = {
    "scenario": "buttons",
    "total_steps": 600,
    "n_envs": 1,
    "updates_per_episode": 0.5,
    "batch_episodes": 4,
    "replay_episodes": 20,
    "epsilon_anneal_steps": 600,
    "test_interval_steps": 200,
    "test_episodes": 3,
    "checkpoint_interval_steps": 200,
    "loggers": {"tensorboard": False},
    "learner": {"hidden": 16, "mixing_hidden": 8, "hypernet_hidden": 8},
}


def small(**changes: object) -> TrainConfig:
    return TrainConfig.model_validate({**SMALL, **changes})


@dataclass
class Player:
    """One graph: a sim, a team that acts for itself, and a coach."""

    config: TrainConfig
    graph: int = 0
    first_episode: int = 0
    agents: list[bytes] = field(default_factory=list)
    """The net that every episode was played with."""

    def __post_init__(self) -> None:
        self.env: Env = make_env(self.config.scenario, 1)
        self.seed = graph_seed(self.config.seed, self.graph)
        self.sim = Sim(self.env, self.seed, self.first_episode)
        self.coach = Coach(self.config.coach, TeamSpec.of(self.env.spec), self.seed)
        self.live: LiveAgent[int] | None = None

    def weights(self, task: Task, from_episode: int) -> Weights:
        spec = self.env.spec
        return Weights.read(
            task.number,
            from_episode,
            task.epsilon,
            self.seed,
            spec.robots,
            spec.obs_size,
            spec.n_actions,
            task.agent,
        )

    def play(self, task: Task) -> RecordedEpisode:
        sim, spec = self.sim, self.env.spec
        sim.begin()
        plan = self.coach.plan(sim.episode)
        if self.live is None:
            self.live = LiveAgent(self.weights(task, sim.episode), ())
        else:
            self.live.offer(self.weights(task, sim.episode))
        self.agents.append(task.agent)
        self.live.begin(sim.episode)
        obs, state, available = [sim.obs.copy()], [sim.state.copy()], [sim.available.copy()]
        actions, reward, faults, intents = [], [], [], []
        while sim.running:
            intent = self._act(self.live)
            executed, modes = self._gate(plan, intent)
            sim.advance(executed, (modes != 0).astype(np.uint8))
            for rows, value in ((obs, sim.obs), (state, sim.state), (available, sim.available)):
                rows.append(value.copy())
            actions.append(executed), reward.append(sim.reward)
            faults.append(modes), intents.append(intent)
        episode = Episode(
            np.array(obs, np.float32),
            np.array(state, np.float32),
            np.array(available, np.bool_),
            np.array(actions, np.int32),
            np.array(reward, np.float32),
            np.array(faults, np.uint8),
            sim.terminated,
        )
        return RecordedEpisode(
            bag=f"graph {self.graph}",
            robots=spec.robots,
            seed=self.seed,
            number=sim.episode,
            episode=episode,
            intents=np.array(intents, np.int32),
            success=sim.success,
            plan=plan,
            modes={},
            trajectory_hash=sim.trajectory_hash,
        )

    def _act(self, live: LiveAgent[int]) -> npt.NDArray[np.int32]:
        sim, answers = self.sim, []
        for robot in range(self.env.spec.n_robots):
            sensed = Sensed(
                sim.episode,
                sim.step,
                int(sim.last_actions[robot]),
                sim.obs[robot],
                sim.available[robot].astype(np.uint8),
                robot,
            )
            answers += live.agent.receive(robot, sensed)
        return np.array([answer.action for answer in answers], np.int32)

    def _gate(
        self, plan: CrashPlan, intent: npt.NDArray[np.int32]
    ) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.uint8]]:
        """Mute faults from the first step on, as the coach's defaults plan them."""
        modes = np.zeros(len(intent), np.uint8)
        modes[[fault.robot for fault in plan.faults]] = 1
        return np.where(modes != 0, self.sim.stay(), intent).astype(np.int32), modes


class InProcess:
    """A lock-step run and its graphs; episodes arrive in an order of ``shuffle``'s choice."""

    def __init__(self, config: TrainConfig, shuffle: int | None = None) -> None:
        self.waiting: list[Task] = []
        self.session = LiveSession(config, SPEC, Lockstep, self.take)
        self.players = [Player(config, graph) for graph in range(config.n_envs)]
        self.lines: list[dict[str, Value]] = []
        self.tasks: list[Task] = []
        self.shuffle = None if shuffle is None else random.Random(shuffle)

    def take(self, tasks: list[Task]) -> None:
        self.waiting += tasks
        self.tasks += tasks

    def end_block(self) -> None:
        line = self.session.end_block()
        self.lines.append(line)
        for player in self.players:
            player.coach.record_block(float(line["success_rate"] or 0), Progress(0, 0, 0))

    def go(self, lose: frozenset[int] = frozenset()) -> None:
        """To the end; the episodes of the tasks in ``lose`` are lost."""
        while not self.session.finished:
            tasks, self.waiting = self.waiting, []
            done = [(task, self.players[task.graph].play(task)) for task in tasks]
            if self.shuffle is not None:
                self.shuffle.shuffle(done)
            for task, recorded in done:
                self.session.played(task, None if task.number in lose else recorded)
            for _ in done or [None]:
                self.session.advance()
            if self.session.block_due:
                self.end_block()


class StoppedError(Exception):
    """The trainer's process dies here."""


def wait(run: LiveRun) -> None:
    deadline = time.monotonic() + 60
    while not run.done:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def live(
    config: TrainConfig, out: Path, resume: bool, die_after_blocks: int = 1000
) -> list[dict[str, Value]]:
    """A run on one graph, whose sim goes on where the checkpoint says."""
    blocks: list[dict[str, Value]] = []

    def on_block(number: int, line: dict[str, Value]) -> None:
        blocks.append(line)
        if len(blocks) == die_after_blocks:
            raise StoppedError

    def on_tasks(tasks: list[Task]) -> None:
        for task in tasks:
            run.session.played(task, player.play(task))

    run = LiveRun(config, SPEC, out, resume, "lockstep", on_tasks, on_block, print)
    with run:
        player = Player(config, first_episode=run.session.next_episodes[0])
        run.start()
        wait(run)
    return blocks
