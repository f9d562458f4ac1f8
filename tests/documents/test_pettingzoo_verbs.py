"""Every verb that can play somebody else's environment does; the others say why not."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from in_process import refused, typed

from crash_coach_common.strict_yaml import ConfigError
from policy_pkg.sweep.config import load_sweep

SUPPORT = Path(__file__).resolve().parent.parent / "support"
SETTINGS = (
    "scenario=pettingzoo:corridor_env:Corridor", "env_args.length=5", "env_rules.stay_action=0",
    "env_rules.success_info=all_through", "total_steps=1200", "n_envs=4", "batch_episodes=4",
    "replay_episodes=50", "updates_per_episode=0.5", "test_interval_steps=400", "test_episodes=4",
    "loggers.tensorboard=false",
    "learner.hidden=16", "coach.strategy=adaptive", "coach.adaptive.beta=0",
)  # fmt: skip


@pytest.fixture(scope="module", autouse=True)
def importable() -> Iterator[None]:
    """Also in the processes that the verbs start."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SUPPORT)
        patch.setenv("PYTHONPATH", str(SUPPORT), prepend=os.pathsep)
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "corridor"
    done = typed("train", "buttons/qmix", "--out", str(out), "--seed", "1", "--set", *SETTINGS)
    assert done.returncode == 0, done.stderr
    assert "1,200" in done.stdout  # steps, in a table
    assert "RunSummary" not in done.stdout
    return out


def evaluated(run: Path, out: Path, *options: str) -> dict[str, object]:
    done = typed("evaluate", str(run), "--episodes", "6", *options, "--json", str(out))
    assert done.returncode == 0, done.stderr
    content: dict[str, object] = json.loads(out.read_text())
    return content


def test_evaluate_with_one_agent_crashed_in_any_number_of_processes(
    run: Path, tmp_path: Path
) -> None:
    options = ("--crashed", "0", "1", "--mode", "random")
    one = evaluated(run, tmp_path / "one.json", *options)
    two = evaluated(run, tmp_path / "two.json", *options, "--processes", "2")
    assert one == two
    free, crashed = one["conditions"]  # type: ignore[misc]
    assert (free["crashed_fraction"], crashed["crashed_fraction"]) == (0, 0.5)
    assert free["trajectory_hash"] != crashed["trajectory_hash"]
    slow = evaluated(run, tmp_path / "slow.json", "--victims", "slow_1", "--mode", "delay")
    assert slow["conditions"][-1]["name"] == "slow_1 delay"  # type: ignore[index]


def test_a_muted_agent_never_gets_through(run: Path, tmp_path: Path) -> None:
    muted = evaluated(run, tmp_path / "muted.json", "--victims", "slow_1")
    assert muted["conditions"][-1]["success_rate"] == 0  # type: ignore[index]
    assert muted["conditions"][-1]["steps_mean"] == 20  # type: ignore[index]


def test_what_scripted_teams_achieve(tmp_path: Path) -> None:
    hall = tmp_path / "hall.yaml"
    hall.write_text(
        "kind: pettingzoo\nenvironment: corridor_env:Corridor\nstay_action: 0\n"
        "success_info: all_through\n"
    )
    hold = typed("evaluate", "scripted:hold", "--scenario", str(hall), "--episodes", "3")
    assert "0.0 %" in hold.stdout
    assert "20.0" in hold.stdout
    told = refused("evaluate", "scripted:kite", "--scenario", str(hall))
    assert "hold, random" in told


def test_report_plot_and_profile(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "report"
    done = typed("report", str(run), "--episodes", "4", "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert "pettingzoo:corridor_env:Corridor" in (out / "table.md").read_text()
    assert typed("plot", str(run), "--out", str(tmp_path / "curves")).returncode == 0
    done = typed("profile", "buttons/qmix", "--seconds", "1", "--set", *SETTINGS[:-2])
    assert done.returncode == 0, done.stderr
    assert "simulator" in done.stdout


@pytest.mark.parametrize("name", ["a.png", "a.gif", "a.mp4"])
def test_render_shows_the_environments_own_pictures(run: Path, tmp_path: Path, name: str) -> None:
    done = typed("render", str(run), "--victims", "slow_1", "--out", str(tmp_path / name))
    assert done.returncode == 0, done.stderr
    assert "no success after 20 steps; crashed: slow_1" in done.stdout
    assert (tmp_path / name).stat().st_size > 1000


def test_a_sweep_expands_to_runs_of_it(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep.yaml"
    sweep.write_text(
        "config: buttons/qmix\nscenarios: ['pettingzoo:corridor_env:Corridor']\nseeds: [1]\n"
        "set: {env_rules.stay_action: 0}\ngrid: {env_args.length: [4, 5]}\n"
    )
    runs = load_sweep(sweep)
    assert [run.name for run in runs] == ["corridor_env/length_4-s1", "corridor_env/length_5-s1"]
    assert [run.config.env_args for run in runs] == [{"length": 4}, {"length": 5}]
    sweep.write_text(sweep.read_text().replace("stay_action: 0", "stay_action: 7"))
    with pytest.raises(ConfigError, match="stay_action = 7"):
        load_sweep(sweep)


def test_what_needs_bodies_or_a_graph_says_so(run: Path, tmp_path: Path) -> None:
    for arguments in (
        ("evaluate", str(run), "--via", "ros", "--episodes", "1"),
        ("up", "pettingzoo:corridor_env:Corridor", "--policy", str(run)),
        ("calibrate", "pettingzoo:corridor_env:Corridor"),
    ):  # fmt: skip
        assert "PettingZoo environment" in refused(*arguments)
    near = tmp_path / "near.yaml"
    near.write_text(
        "description: near\nfaults: [{crash_mode: mute, near_radius_m: 1.0}]\n"
        "expect: [{success_rate: {at_least: 0}}]\n"
    )
    assert "does not tell where its robots are" in refused(
        "faults", "run", str(near), "--policy", str(run), "--out", str(tmp_path / "verdict")
    )
