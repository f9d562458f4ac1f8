"""A live training run and its graphs."""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from crash_coach_interfaces.msg import BlockResult

from crash_coach_common.contract import EnvSpec
from policy_pkg.ros.trainer.link import Graph, GraphLink
from policy_pkg.ros.trainer.lockstep import LockstepLink
from policy_pkg.ros.trainer.params import OWN_DOMAIN, TrainerParameters
from policy_pkg.ros.trainer.realtime import RealTimeLink
from policy_pkg.train.config import TrainConfig, graph_seed
from policy_pkg.train.live.order import Task
from policy_pkg.train.live.run import LiveRun, load_spec, reads_blocks
from policy_pkg.train.metrics import Value

POLL_S = 0.1  # how soon a signal or an end is noticed


class Trainer:
    """Learns in one thread, serves each graph in another.

    Raises:
        UserError: the configuration's scenario is wrong.
    """

    def __init__(self, parameters: TrainerParameters, config: TrainConfig) -> None:
        self._config = config
        spec = load_spec(config)
        self._stop = threading.Event()
        resume, mode = parameters.resume, parameters.mode
        self._run = LiveRun(
            *(config, spec, Path(parameters.out), resume, mode),
            *(self._give, self._tell_block, self._warn),
        )
        self._graphs = graphs(parameters, config, spec)
        self._links: list[GraphLink] = []

    def run(self, received: list[int]) -> None:
        """Until the run is finished or a signal was received.

        Raises:
            UserError: a graph does not answer, training diverged, or a result cannot be written.
        """
        with self._run, ThreadPoolExecutor(len(self._graphs)) as threads:
            for graph in self._graphs:
                link = LockstepLink if graph.lockstep else RealTimeLink
                self._links.append(link(graph, self._run.session.played, self._stop.is_set))
            serving = [threads.submit(link.serve) for link in self._links]
            try:
                self._run.start()
                while not received and not self._run.done:
                    _raise_failure(serving)
                    self._stop.wait(POLL_S)
            finally:
                self._stop.set()
        _raise_failure(serving)

    def _give(self, tasks: list[Task]) -> None:
        for task in tasks:
            self._links[task.graph].give(task)

    def _tell_block(self, number: int, line: dict[str, Value]) -> None:
        """The coaches hear of it before any episode after it begins."""
        success, steps = line["success_rate"], line["env_steps"]
        self._say(
            f"{steps} steps, {line['episodes']} episodes: success {success}, "
            f"return {line['return_mean']:.3g}, crash rate {line['alpha']:g}"
        )
        if not isinstance(success, float) or not isinstance(steps, int):
            return  # the scenario reports no success
        block = BlockResult(
            block=number,
            episodes=self._config.test_episodes,
            success_rate=success,
            env_steps=steps,
        )
        for told in [link.give_block(block) for link in self._links]:
            while not self._stop.is_set():
                try:
                    if not told.result(POLL_S):
                        self._warn(f"a coach did not take block {number}")
                    break
                except TimeoutError:
                    continue

    def _say(self, text: str) -> None:
        print(f"trainer: {text}", flush=True)  # noqa: T201

    def _warn(self, text: str) -> None:
        self._say(f"warning: {text}")


def _raise_failure(serving: list[Future[None]]) -> None:
    for future in serving:
        if future.done():
            future.result()


def graphs(parameters: TrainerParameters, config: TrainConfig, spec: EnvSpec) -> list[Graph]:
    return [
        Graph(
            index=index,
            domain=None if domain == OWN_DOMAIN else domain,
            spec=spec,
            lockstep=parameters.mode == "lockstep",
            observation_topic=parameters.observation_topic,
            seed=graph_seed(config.seed, index),
            coached=reads_blocks(config),
        )
        for index, domain in enumerate(parameters.domains)
    ]
