"""`crash-coach evaluate`: twice, on two processes or over ROS, the same table to the last digit."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from crash_coach_bringup.cli.main import repeat_options, typed_app
from crash_coach_bringup.cli.output import CliError
from crash_coach_common.contract import UserError
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.conditions import at_rate, crash_free, exactly
from policy_pkg.play.evaluate import Evaluation, Scripted
from policy_pkg.play.evaluate_processes import evaluate_on
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

SCENARIO = "skirmish/3m"  # returns, lengths and who dies differ from episode to episode
EPISODES = 7


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("team") / "step_000000000"
    write_untrained(folder, make_env(SCENARIO, 1).spec, seed=3)
    return folder


Table = tuple[list[str], list[dict[str, Any]]]


@pytest.fixture
def table(
    checkpoint: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> Callable[..., Table]:
    """What the verb prints below the title, and the conditions of its JSON file."""
    out = tmp_path / "result.json"

    def evaluated(*options: str) -> Table:
        fixed = ["evaluate", str(checkpoint), "--episodes", str(EPISODES), "--json", str(out)]
        arguments = [*fixed, *options]
        typed_app(arguments)(repeat_options(arguments), standalone_mode=False)
        title, edge, rows = capfd.readouterr().out.partition("┏")
        assert "episodes each" in " ".join(title.split())
        return (edge + rows).splitlines(), json.loads(out.read_text())["conditions"]

    return evaluated


@pytest.mark.parametrize("crash", [[], ["--crash-rate", "0.3", "--crashed", "1"]])
def test_the_same_table_however_it_is_played(table: Callable[..., Table], crash: list[str]) -> None:
    once = table(*crash)
    assert table(*crash) == once
    if crash:  # the conditions together, since processes are slow to start
        assert table(*crash, "--processes", "2") == once
        assert table(*crash, "--via", "ros", "--layout", "single") == once
    lines, conditions = once
    assert "trajectory hash" in lines[-1]
    assert [c["name"] for c in conditions] == (
        ["crash-free", "rate 0.3", "1 crashed"] if crash else ["crash-free"]
    )
    for condition in conditions:
        rows = condition["per_episode"]
        assert len({row["trajectory_hash"] for row in rows}) == EPISODES
        assert len({row["episode_return"] for row in rows}) > 1


def test_another_seed_gives_another_table(table: Callable[..., Table]) -> None:
    first, other = (table("--crash-rate", "0.3", "--seed", seed) for seed in "01")
    assert first[0] != other[0]
    assert first[1] != other[1]


def played(processes: int, episodes: int) -> list[Evaluation]:
    conditions = [crash_free(), at_rate(0.3), exactly(1, "random")]
    return evaluate_on(processes, Scripted("random"), SCENARIO, conditions, episodes, 5)


def test_parts_of_different_lengths_and_more_processes_than_episodes() -> None:
    whole = played(1, 5)
    assert [[e.episode for e in run.episodes] for run in whole] == [[0, 1, 2, 3, 4]] * 3
    assert played(2, 5) == whole
    assert played(9, 1) == played(1, 1)


def test_errors_come_from_a_process_as_they_are(checkpoint: Path) -> None:
    with pytest.raises(UserError, match="3 robots"):
        evaluate_on(2, load_policy(checkpoint), SCENARIO, [exactly(9)], 4, 0)
    arguments = ["evaluate", str(checkpoint), "--via", "ros", "--processes", "2"]
    with pytest.raises(CliError, match=r"--processes 2: .*one graph"):
        typed_app(arguments)(arguments, standalone_mode=False)


def test_a_process_that_dies_ends_the_evaluation(checkpoint: Path) -> None:
    code = (
        "from pathlib import Path\n"
        "from policy_pkg.checkpoint import load_policy\n"
        "from policy_pkg.play.conditions import crash_free\n"
        "from policy_pkg.play.evaluate_processes import evaluate_on\n"
        "if __name__ == '__main__':\n"
        f"    team = load_policy(Path({str(checkpoint)!r}))\n"
        f"    evaluate_on(2, team, {SCENARIO!r}, [crash_free()], 1_000_000, 0)\n"
    )
    script = checkpoint.parent / "long.py"
    script.write_text(code)
    parent = subprocess.Popen([sys.executable, str(script)], stderr=subprocess.PIPE, text=True)
    try:
        os.kill(worker_of(parent.pid), signal.SIGKILL)
        _, text = parent.communicate(timeout=250)
    finally:
        parent.kill()
    assert parent.returncode == 1
    assert "a process of the evaluation died, exit code -9" in text


def worker_of(parent: int) -> int:
    """The first process that ``parent`` spawned for work; waits for it."""
    deadline_s = time.monotonic() + 60
    while time.monotonic() < deadline_s:
        for child in Path(f"/proc/{parent}/task/{parent}/children").read_text().split():
            if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
                return int(child)
        time.sleep(0.05)
    raise AssertionError("no process was spawned")
