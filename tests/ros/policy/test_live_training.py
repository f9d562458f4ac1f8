"""Training over real topics: the same run as in this process; a trainer that dies and returns."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from crash_coach_interfaces.msg import EpisodeState
from in_process import typed
from live_player import InProcess, small
from rclpy.qos import QoSProfile

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    Layout,
    check_team,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.live import LiveOptions, graph_options, run_live, trainer_process
from crash_coach_bringup.ros.supervisor import Event, Supervisor
from policy_pkg.checkpoint import load_policy
from policy_pkg.train.config import load_train_config
from policy_pkg.train.run import train

WAIT_S = 90.0
TOLD = "{run}: saved at {steps:,} steps; the same command with --resume goes on from there"
NOTHING = "{run}: interrupted before there was anything to save"


def overrides(**changes: Any) -> tuple[str, ...]:
    """What makes live/buttons a small run, as --set takes it."""
    values = small(**changes).model_dump(mode="json")
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if key in ("learner", "coach"):
            flat |= {f"{key}.{k}": v for k, v in value.items()}
        elif key not in ("scenario", "seed"):
            flat[key] = value
    return tuple(f"{key}={json.dumps(value)}" for key, value in flat.items())


def metrics(run: Path) -> list[dict[str, Any]]:
    path = run / "metrics.jsonl"
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def trained(tmp_path: Path, layout: Layout, changes: dict[str, Any]) -> Path:
    events: list[Event] = []
    lines: list[str] = []
    run = tmp_path / "run"
    options = LiveOptions("live/buttons", run, overrides(**changes), seed=3, layout=layout)
    assert run_live(options, events.append, lines.append) == 0, (events, lines)
    assert [event.kind for event in events if event.kind != "started"] == ["finished", "stopped"]
    assert not [line for line in lines if "left out" in line or "warning" in line]
    return run


@pytest.mark.parametrize(
    ("layout", "graphs"),
    [
        ("single", 1),
        pytest.param("single", 2, marks=pytest.mark.soak),
        pytest.param("nodes", 1, marks=pytest.mark.soak),
        pytest.param("team", 1, marks=pytest.mark.soak),
    ],
)
def test_lock_step_over_ros_is_bit_for_bit_the_run_in_this_process(
    tmp_path: Path, layout: Layout, graphs: int
) -> None:
    coach = {"strategy": "adaptive", "adaptive": {"beta": 0.0, "rho": 0.4, "alpha_max": 0.9}}
    changes = {"n_envs": graphs, "coach": coach}
    core = InProcess(small(seed=3, **changes))
    core.go()
    run = trained(tmp_path, layout, changes)
    assert metrics(run) == core.lines
    assert core.session.counters.episodes > 30
    assert [line["alpha"] for line in core.lines] == pytest.approx([0.0, 0.4, 0.64, 0.784])
    newest = sorted((run / "checkpoints").iterdir())[-1]
    assert (newest / "agent.safetensors").read_bytes() == core.session.agent
    assert load_policy(run).scenario == "buttons"


@pytest.mark.soak
def test_lock_step_killed_and_resumed_is_as_if_it_had_never_stopped(tmp_path: Path) -> None:
    changes = {"coach": {"strategy": "fixed", "crash_rate": 0.3}, "total_steps": 1000}
    core = InProcess(small(seed=3, **changes))
    core.go()
    run, log = tmp_path / "run", tmp_path / "log"
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "train-live", "live/buttons"]
    command += ["--out", str(run), "--seed", "3", "--resume", "--set", *overrides(**changes)]
    saved = run / "checkpoints"
    with log.open("wb") as file, subprocess.Popen(command, stdout=file, stderr=file) as child:
        until(lambda: saved.is_dir() and any(saved.iterdir()), "a checkpoint", log)
        child.kill()
    assert len(metrics(run)) < len(core.lines)
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert metrics(run) == core.lines
    newest = sorted(saved.iterdir())[-1]
    assert (newest / "agent.safetensors").read_bytes() == core.session.agent


@pytest.mark.soak
def test_ctrl_c_ends_all_and_says_how_to_go_on(tmp_path: Path) -> None:
    run, log = tmp_path / "run", tmp_path / "log"
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "train-live", "live/buttons"]
    command += ["--out", str(run), "--set", *overrides(total_steps=1_000_000)]
    saved = run / "checkpoints"
    with log.open("wb") as file, subprocess.Popen(command, stdout=file, stderr=file) as child:
        until(lambda: saved.is_dir() and any(saved.iterdir()), "a checkpoint", log)
        child.send_signal(signal.SIGINT)
        assert child.wait(WAIT_S) == 130, log.read_text()
    newest = int(sorted(saved.iterdir())[-1].name.removeprefix("step_"))
    assert log.read_text().splitlines()[-1] == TOLD.format(run=run, steps=newest)


def test_an_interrupted_command_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command's part, with what lies there when the processes have ended."""

    def interrupted(options: LiveOptions, *tell: Any) -> int:
        options.out.mkdir(exist_ok=True)
        return 130

    monkeypatch.setattr("crash_coach_bringup.ros.live.run_live", interrupted)
    run = tmp_path / "run"
    done = typed("train-live", "live/buttons", "--out", str(run))
    assert (done.returncode, done.stdout.strip()) == (130, NOTHING.format(run=run))
    train(small(total_steps=200), run)
    done = typed("train-live", "live/buttons", "--out", str(run), "--resume")
    assert (done.returncode, done.stdout.strip()) == (130, TOLD.format(run=run, steps=200))


# --- a trainer that dies --------------------------------------------------------------------


@contextmanager
def trainer(argv: tuple[str, ...], domain: int, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as file:
        child = subprocess.Popen(
            argv, stdout=file, stderr=file, env={**os.environ, **graph_environment(domain)}
        )
        try:
            yield child
        finally:
            child.kill()
            child.wait(10)


def until(ready: Any, what: str, log: Path) -> None:
    deadline = time.monotonic() + WAIT_S
    while not ready():
        assert time.monotonic() < deadline, f"{what}: {log.read_text()}"
        time.sleep(0.05)


class Episodes:
    """The newest episode that a graph plays."""

    def __init__(self, client: GraphClient) -> None:
        self._client, self.newest = client, -1
        client.node.create_subscription(
            EpisodeState, "/sim/boundary", self._on_state, QoSProfile(depth=100)
        )

    def _on_state(self, state: EpisodeState) -> None:
        self.newest = state.episode

    def go_on(self) -> None:
        """Returns when three more have begun."""
        start = self.newest
        self._client.until(lambda: self.newest >= max(start, 0) + 3, WAIT_S, "more episodes")


@pytest.mark.soak
def test_in_real_time_the_graph_outlives_a_trainer_that_is_killed_and_returns(
    tmp_path: Path,
) -> None:
    run, log = tmp_path / "run", tmp_path / "trainer.log"
    log.touch()
    options = LiveOptions(
        "live/buttons",
        run,
        overrides(total_steps=600),
        resume=True,
        mode="realtime",
        sim={"real_time_factor": 80.0},
    )
    config = load_train_config(options.config, options.overrides)
    with reserve_domain() as domain:
        graph = graph_options(options, config, 0, domain, 0)
        argv = trainer_process(options, config, [domain]).argv
        processes = graph_processes(graph, check_team(graph))
        with Supervisor(processes, tmp_path / "logs", graph_environment(domain)) as supervisor:

            def check() -> None:
                assert supervisor.wait(0.0) == []

            with graph_client("observer", domain, check) as client:
                episodes = Episodes(client)
                with trainer(argv, domain, log) as first:
                    saved = run / "checkpoints"
                    until(lambda: saved.is_dir() and any(saved.iterdir()), "a checkpoint", log)
                    assert first.poll() is None, log.read_text()
                    first.send_signal(signal.SIGKILL)
                    first.wait(10)
                before = metrics(run)
                assert len(before) >= 2
                episodes.go_on()
                with trainer(argv, domain, log) as second:
                    until(lambda: second.poll() is not None, "the second trainer's end", log)
                    assert second.returncode == 0, log.read_text()
                after = metrics(run)
                assert after[: len(before) - 1] == before[:-1]
                assert after[-1]["env_steps"] >= 600
                assert after[-1]["gradient_steps"] > before[-1]["gradient_steps"]
                episodes.go_on()


def test_what_cannot_work_is_one_line_of_error(tmp_path: Path) -> None:
    with reserve_domain() as domain:
        options = LiveOptions("live/buttons", tmp_path / "run")
        config = load_train_config("live/buttons")
        argv = trainer_process(options, config, [domain]).argv
        command = [part.replace("resume:=false", "resume:=1") for part in argv]
        for arguments, text in (
            (command, "parameter resume = 1: "),
            ([*argv[:-1], "-p", "lag:=2", "--"], "unknown parameter 'lag' of trainer; known: "),
            ([*argv[:-1], "-p", "domains:=[3, 4]", "--"], "n_envs = 1 graphs, but parameter dom"),
            ([*argv[:-1], "-p", "config:=live/button", "--"], "did you mean"),
        ):
            done = subprocess.run(
                arguments, capture_output=True, text=True, timeout=60, check=False
            )
            assert done.returncode == 1
            error = done.stderr.strip().splitlines()
            assert len(error) == 1, done.stderr
            assert error[0].startswith("trainer: error: ")
            assert text in error[0]
    assert not (tmp_path / "run").exists()
