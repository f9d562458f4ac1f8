"""A package from outside the repository adds a scenario kind, a strategy, a fault, a mixer and
a logger: all of them are used from the command line."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path

import pytest
from own_package import POINTS, SOURCE, install, install_really
from safetensors.numpy import load_file

from crash_coach_bringup.ros.probe import find_executable
from policy_pkg.checkpoint import find_checkpoint
from sim_pkg.scenario_files import SCENARIOS_DIR

STEPS = 300
SMALL = f"""
scenario: {{scenario}}
total_steps: {STEPS}
n_envs: 2
batch_episodes: 4
replay_episodes: 20
test_interval_steps: 100
test_episodes: 2
checkpoint_interval_steps: {STEPS}
loggers: {{{{tensorboard: false, diary: {{{{title: Patrol}}}}}}}}
learner: {{{{algorithm: weighted, hidden: 16, mixing_hidden: 8, hypernet_hidden: 8}}}}
coach: {{{{strategy: steady, crash_mode: limp, crash_parameters: {{{{every: 3}}}}}}}}
"""


def crash_coach(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A command where the package in ``site`` is installed."""
    command = [str(find_executable("crash_coach_bringup", "crash-coach")), *arguments]
    paths = [str(site), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    return subprocess.run(command, capture_output=True, text=True, timeout=250, env=env)


def patrol(folder: Path, reward_company: float) -> Path:
    text = (SCENARIOS_DIR / "buttons.yaml").read_text()
    path = folder / f"patrol_{reward_company}.yaml"
    path.write_text(
        text.replace("kind: buttons", f"kind: patrol\nreward_company: {reward_company}")
    )
    return path


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("outside")
    install_really(folder / "own_robots", folder / "site")
    return folder / "site"


@pytest.fixture(scope="module")
def run(site: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained on the kind, by the strategy, with the fault."""
    folder = tmp_path_factory.mktemp("runs")
    config = folder / "patrol.yaml"
    config.write_text(SMALL.format(scenario=patrol(folder, 0.5)))
    done = crash_coach(site, "train", str(config), "--out", str(folder / "run"), "--seed", "1")
    assert done.returncode == 0, done.stderr
    assert "diary was not told metrics at 200 steps: no ink" in " ".join(done.stdout.split())
    return folder / "run"


def test_the_strategy_decides_the_rate_of_the_training(run: Path) -> None:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["alpha"] for line in lines] == [0.25, 0.5, 0.5, 0.5]
    assert lines[-1]["crashed_fraction"] > 0


def test_the_logger_is_told_of_the_run(run: Path) -> None:
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    told = [f"{line['env_steps']}: {line['success_rate']}" for line in lines]
    assert (run / "diary.txt").read_text().splitlines() == [
        "Patrol: from step 0, hidden 16, commit True", told[0], told[1], told[3], "finished",
    ]  # fmt: skip
    assert not (run / "tensorboard").exists()


def test_the_mixer_is_what_the_training_learns(run: Path) -> None:
    kept = load_file(find_checkpoint(run) / "learner.safetensors")
    assert {name for name in kept if "mixer" in name} == {
        f"{net}.mixer.{layer}.{part}"
        for net in ("online", "target")
        for layer in ("weigh", "value")
        for part in ("weight", "bias")
    }


def test_the_team_is_evaluated_on_the_kind_under_the_fault(
    site: Path, run: Path, tmp_path: Path
) -> None:
    means = []
    for reward_company in (0.0, 100.0):
        scenario = str(patrol(tmp_path, reward_company))
        out = tmp_path / f"{reward_company}.json"
        arguments = [
            "--episodes",
            "2",
            "--victims",
            "robot_1",
            "--mode",
            "limp",
            "--json",
            str(out),
        ]
        done = crash_coach(site, "evaluate", str(run), "--scenario", scenario, *arguments)
        assert done.returncode == 0, done.stderr
        means.append(json.loads(out.read_text())["conditions"][0]["return_mean"])
    assert means[0] <= means[1]
    picture = tmp_path / "patrol.png"
    scripted = ["render", "scripted:random", "--scenario", str(patrol(tmp_path, 0.0))]
    done = crash_coach(site, *scripted, "--out", str(picture))
    assert done.returncode == 0, done.stderr
    assert picture.stat().st_size > 1000


@pytest.mark.parametrize("kind", ["crash_coach.scenarios", "crash_coach.faults"])
def test_what_cannot_be_used_is_named(run: Path, tmp_path: Path, kind: str) -> None:
    wrong = POINTS.replace("own:KIND", "own:PatrolConfig").replace("own:Limp", "own:Limped")
    install(
        tmp_path / "site",
        SOURCE,
        wrong if kind.endswith("faults") else wrong.replace("Limped", "Limp"),
    )
    scenario = str(patrol(tmp_path, 0.0))
    arguments = [
        "--scenario",
        scenario,
        "--victims",
        "robot_1",
        "--mode",
        "limp",
        "--episodes",
        "1",
    ]
    done = crash_coach(tmp_path / "site", "evaluate", "scripted:random", *arguments)
    said = " ".join(done.stderr.split())
    assert done.returncode == 1, said
    assert "entry point" in said
    assert "own-robots" in said
    assert "Traceback" not in said


def test_without_the_package_nothing_of_it_is_known(tmp_path: Path) -> None:
    scenario = str(patrol(tmp_path, 0.0))
    done = crash_coach(tmp_path, "evaluate", "scripted:random", "--scenario", scenario)
    assert done.returncode == 1
    assert "kind = 'patrol'" in " ".join(done.stderr.split())
