"""Runs of a sweep as tasks of a Ray cluster whose nodes share a file system."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

from policy_pkg.sweep.folder import check_mark, leave_mark
from policy_pkg.sweep.sweep import Ended
from policy_pkg.sweep.task import Child, Task
from policy_pkg.train.run_dir import RunError

# Read when Ray is imported: nothing is sent to its makers.
os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
try:
    import ray
    from ray.exceptions import GetTimeoutError, RayError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ModuleNotFoundError as error:
    raise RunError(
        f"--engine ray needs the extra package {error.name}: install it with `make ray`, or with "
        "`pip install -r requirements-ray.lock`, on every node"
    ) from error

MOST_RETRIES = 10  # of a task whose node was lost
CHECK_S = 120.0
CONNECT_S = 10.0


def check_reachable(address: str) -> None:
    """Raises RunError where nobody answers at host:port, which Ray would try for minutes."""
    host, colon, port = address.rpartition(":")
    if not colon or "/" in address:
        return
    try:
        socket.create_connection((host, int(port)), CONNECT_S).close()
    except (OSError, ValueError) as error:
        raise RunError(f"--address {address}: no Ray cluster: {error}") from error


def perform(task: str, mark: str) -> str | None:
    """On a node: a run's process until it ends; why the run is not finished, or None."""
    wanted = Task.model_validate_json(task)
    try:
        check_mark(wanted.out, mark)
        child = Child(wanted)
    except (RunError, OSError) as error:
        return f"node {ray.util.get_node_ip_address()}: {error}"
    return None if child.wait() == 0 else child.failure()


class RayEngine:
    """Tasks of one CPU each, begun anew on another node when theirs is lost.

    Whatever is left of a lost node's process is kept off by the run's lock.

    Args:
        out: the sweep's folder, which every node has to see.
        slots: tasks that are given to the cluster at a time.
        address: of a cluster; None: $RAY_ADDRESS, a cluster that runs here, or a new one here.

    Raises:
        RunError: no such cluster, or one of its nodes cannot do runs; says which and why.
        OSError: ``out`` cannot be written.
    """

    def __init__(self, out: Path, slots: int, address: str | None = None) -> None:
        self.slots = slots
        self._tasks: dict[Any, str] = {}
        self._mark = leave_mark(out)
        check_reachable(address or os.environ.get("RAY_ADDRESS", ""))
        try:
            ray.init(address=address, log_to_driver=False, logging_level="error")
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise RunError(f"--address {address}: no Ray cluster: {error}") from error
        try:
            self._check_nodes(str(out))
        except RunError:
            ray.shutdown()
            raise
        self._remote = ray.remote(num_cpus=1, max_retries=MOST_RETRIES)(perform)

    def _check_nodes(self, out: str) -> None:
        nodes = [n for n in ray.nodes() if n["Alive"] and n["Resources"].get("CPU", 0) >= 1]
        if not nodes:
            raise RunError("the Ray cluster has no node with a CPU")
        check = ray.remote(num_cpus=0, max_retries=0)(check_mark)
        answers = {}
        for node in nodes:
            there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            name = f"{node['NodeManagerHostname']} ({node['NodeManagerAddress']})"
            task = check.options(scheduling_strategy=there)
            answers[name] = task.remote(out, self._mark)
        for name, answer in answers.items():
            try:
                ray.get(answer, timeout=CHECK_S)
            except GetTimeoutError as error:
                raise RunError(f"Ray node {name} did not answer in {CHECK_S:g} s") from error
            except RayError as error:
                raise RunError(
                    f"Ray node {name} cannot do runs: {_last_line(error)} (all nodes need the "
                    "same folders, and `. ./env.sh` before `ray start`)"
                ) from error

    def start(self, task: Task) -> None:
        self._tasks[self._remote.remote(task.model_dump_json(), self._mark)] = task.name

    def poll(self) -> list[Ended]:
        ended = []
        waiting = list(self._tasks)
        done, _ = ray.wait(waiting, num_returns=len(waiting), timeout=0) if waiting else ([], [])
        for answer in done:
            try:
                error = ray.get(answer)
            except RayError as failure:
                error = f"Ray gave it up: {_last_line(failure)}"
            ended.append(Ended(self._tasks.pop(answer), error))
        return ended

    def stop(self) -> None:
        for answer in self._tasks:
            ray.cancel(answer, force=True)
        self._tasks.clear()
        ray.shutdown()


def _last_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__
