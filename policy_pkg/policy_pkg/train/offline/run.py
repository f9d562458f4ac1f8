"""One run on recorded episodes: what it learns from, and what is told of that."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.offline.data import FixedData, Recorded, load_data
from policy_pkg.train.offline.session import OfflineSession
from policy_pkg.train.progress import OnProgress, RunSummary, silent
from policy_pkg.train.run import Clock, MakeEnv, Run
from policy_pkg.train.run_dir import kept_scenario
from policy_pkg.train.session import TEST_ARENAS
from sim_pkg.env import make_env
from sim_pkg.scenario_source import read_scenario


def read_data(
    config: OfflineConfig, recorded: Iterable[Recorded], environment: MakeEnv = make_env
) -> FixedData:
    """The data set of ``config``: for several runs on the same recordings, read once.

    Raises:
        DataError: recordings, config and scenario do not fit together.
    """
    spec = None if config.scenario is None else environment(config.scenario, 1).spec
    return load_data(recorded, spec, config.memory_limit_mib, config.episode_numbers)


def train_offline(
    config: OfflineConfig,
    data: FixedData,
    out_dir: Path,
    resume: bool = False,
    progress: OnProgress = silent,
    clock: Clock = time.perf_counter,
    environment: MakeEnv = make_env,
    sources: Sequence[str] = (),
    stopped: Callable[[], bool] = lambda: False,
) -> RunSummary:
    """Takes ``config.gradient_steps`` on recorded episodes.

    Args:
        data: the data set, which ``read_data`` gave for this config, but for the seed.
        out_dir: becomes the run's directory; missing or empty, unless ``resume`` is set.
        resume: where ``out_dir`` holds a run on the same recordings already, continue it from
            its newest checkpoint, bit for bit as if it had never stopped.
        clock: monotonic, seconds.
        environment: makes the environment of a scenario with a number of arenas.
        sources: where the recordings come from, for ``run.json``.
        stopped: asked between steps whether to save and end early.

    Raises:
        EndedEarly: ``stopped`` said so; there is a checkpoint, unless it was at step 0.
        UserError: data, config and scenario do not fit together, ``out_dir`` cannot be used,
            a checkpoint is damaged, training diverged, or the result could not be written.
    """
    arenas = min(TEST_ARENAS, config.test_episodes)
    scenario = kept_scenario(out_dir) if resume else None
    if scenario is None and config.scenario is not None:
        scenario = read_scenario(config.scenario)
    env = None if scenario is None else environment(scenario, arenas)
    session = OfflineSession(config, data, env)
    described, told = describe_data(session, sources), warnings(session)
    with Run(
        *(session, out_dir, resume, progress, clock, described, told),
        stopped=stopped,
        scenario=scenario,
        save_stopped=True,
    ) as run:
        return run.go()


def describe_data(session: OfflineSession, sources: Sequence[str]) -> dict[str, Any]:
    """The data set's part of ``run.json``: what it holds, and how its episodes are weighted."""
    data, weights = session.data, session.weights
    crashed = Counter(data.crashed.tolist())
    return {
        "sources": list(sources),
        "sha256": data.sha256,
        "episodes": len(data),
        "bytes": data.episodes.nbytes,
        "success_rate": data.success_rate,
        "duplicates": data.duplicates,
        "episodes_by_crashed": {str(k): crashed[k] for k in sorted(crashed)},
        "crash_weights": None if weights is None else weights.to_json(),
    }


def warnings(session: OfflineSession) -> list[str]:
    """What the user should know of the data set before learning begins."""
    found = []
    if session.data.duplicates:
        found.append(
            f"{session.data.duplicates} of {len(session.data)} episodes repeat another one "
            "(same seed, number and content): were recordings named twice?"
        )
    if session.weights is not None:
        for lacking in session.weights.unrecorded:
            found.append(
                f"no episode with {lacking.crashed} robots crashed was recorded, but at crash_rate "
                f"{session.config.crash_rate:g} their share is {lacking.target:.3g}: left out"
            )
    return found
