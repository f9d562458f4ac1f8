"""Benchmark rows of live training: control steps per second with a trainer and without.

Run alone: ``python -m benchmarks bench_live``. Both graphs are one process in lock-step; the one
without a trainer goes from episode to episode by itself, and is the reference.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from benchmarks.bench_ros import lockstep_steps_per_s, rate_row, refuse_dead, sample
from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import graph_environment
from crash_coach_bringup.ros.live import LiveOptions, live_processes
from crash_coach_bringup.ros.supervisor import Supervisor
from policy_pkg.train.config import load_train_config
from sim_pkg.env import make_env

CONFIG = "live/buttons"
WINDOW_S = 8.0
LEARNING_S = 5.0  # until the replay holds a batch
START_S = 120.0
TARGET_RATIO = 0.5
# One evaluation block, at the start.
OVERRIDES = ("total_steps=10000000", "test_interval_steps=10000000", "test_episodes=1")

Row = dict[str, Any]


def rows() -> list[Row]:
    """All rows: {name, value, unit, reference, ratio, target, ok}."""
    with tempfile.TemporaryDirectory(prefix="crash_coach_bench_") as text:
        folder = Path(text)
        alone = lockstep_steps_per_s(folder, 2, "single", gate=True)
        live = live_steps_per_s(folder)
    row = rate_row("live training over ROS, buttons, one graph", live, alone)
    return [{**row, "target": f"ratio >= {TARGET_RATIO:g}", "ok": live >= TARGET_RATIO * alone}]


def live_steps_per_s(folder: Path) -> float:
    """Control steps per second of a graph whose episodes a trainer starts and learns from."""
    config = load_train_config(CONFIG, OVERRIDES)
    dt_s = make_env(config.scenario, 1).spec.dt_s
    options = LiveOptions(CONFIG, folder / "run", OVERRIDES)
    with reserve_domain() as domain:
        processes = live_processes(options, config, [domain])
        with (
            Supervisor(
                processes, folder / "live_logs", graph_environment(domain), throughput=True
            ) as supervisor,
            graph_client("meter", domain, lambda: refuse_dead(supervisor, 0.0)) as client,
        ):
            wait_for_learning(client, folder / "run" / "metrics.jsonl")
            refuse_dead(supervisor, LEARNING_S)
            start_s, first = sample(client, dt_s)
            refuse_dead(supervisor, WINDOW_S)
            end_s, last = sample(client, dt_s)
    return (last - first) / (end_s - start_s)


def wait_for_learning(client: GraphClient, metrics: Path) -> None:
    """Returns when the first block is behind: from then on training episodes are played."""
    client.until(
        lambda: metrics.exists() and len(metrics.read_text()) > 0, START_S, "the first block"
    )
