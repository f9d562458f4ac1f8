"""Executable ``trainer``: learns from the episodes that running graphs play."""

from __future__ import annotations

import os
import signal
import sys
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import FrameType

import rclpy
from crash_coach_interfaces.msg import BlockResult
from rclpy.exceptions import ParameterException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from crash_coach_pkg.strategies import make_strategy
from policy_pkg.ros.recorder_node import PROFILE, PROFILE_VARIABLE
from policy_pkg.ros.trainer_link import Graph, GraphLink
from policy_pkg.ros.trainer_lockstep import LockstepLink
from policy_pkg.ros.trainer_params import OWN_DOMAIN, TrainerParameters, read_parameters
from policy_pkg.ros.trainer_realtime import RealTimeLink
from policy_pkg.train.config import TrainConfig, load_train_config
from policy_pkg.train.live import LiveRun
from policy_pkg.train.live_order import Task
from policy_pkg.train.live_session import graph_seed
from policy_pkg.train.metrics import Value
from sim_pkg.contract import EnvSpec, UserError
from sim_pkg.env import make_env

POLL_S = 0.1  # how soon a signal or an end is noticed
RCLError: type[Exception] = rclpy_implementation.RCLError  # bad --ros-args, for one


class Trainer:
    """A run and its graphs.

    Raises:
        UserError: the configuration is wrong, or does not fit the parameters.
    """

    def __init__(self, parameters: TrainerParameters) -> None:
        self._config = config = load_config(parameters)
        spec = make_env(config.scenario, 1).spec
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
                self._links.append(link(graph, self._run.played, self._stop.is_set))
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


def load_config(parameters: TrainerParameters) -> TrainConfig:
    """Raises UserError as load_train_config, or for another number of graphs than domains."""
    overrides = [] if parameters.overrides == ["none"] else parameters.overrides
    seed = None if parameters.seed < 0 else parameters.seed
    config = load_train_config(parameters.config, overrides, seed)
    if len(parameters.domains) != config.n_envs:
        raise UserError(
            f"n_envs = {config.n_envs} graphs, but parameter domains has "
            f"{len(parameters.domains)}: {parameters.domains}"
        )
    return config


def graphs(parameters: TrainerParameters, config: TrainConfig, spec: EnvSpec) -> list[Graph]:
    return [
        Graph(
            index=index,
            domain=None if domain == OWN_DOMAIN else domain,
            spec=spec,
            lockstep=parameters.mode == "lockstep",
            observation_topic=parameters.observation_topic,
            seed=graph_seed(config.seed, index),
            coached=make_strategy(config.coach).needs_success,
        )
        for index, domain in enumerate(parameters.domains)
    ]


def _parameters() -> TrainerParameters:
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node("trainer")
        try:
            return read_parameters(node)
        finally:
            node.destroy_node()
    finally:
        rclpy.try_shutdown()


def main() -> int:
    """Exit code 0 at the end or on SIGINT or SIGTERM; 1 after one line of error."""
    received: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        received.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, note)
    # Read when the first node is made. Whoever set it knows better. As the recorder's: a deep queue
    # for what comes while this process is busy.
    os.environ.setdefault(PROFILE_VARIABLE, str(PROFILE))
    try:
        trainer = Trainer(_parameters())
        trainer.run(received)
    except (UserError, ParameterException, RCLError) as error:
        print(f"trainer: error: {error}", file=sys.stderr)  # noqa: T201
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
