"""A sweep's file: the runs it stands for, and what it refuses before anything starts."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from sweep_cases import tiny_runs, write_sweep

from crash_coach_common.strict_yaml import ConfigError
from policy_pkg.report.finished_runs import method_name
from policy_pkg.sweep.config import find_sweep, load_sweep, sweep_names
from policy_pkg.train.config import train_config_names


def test_runs_have_stable_names_seed_by_seed(tmp_path: Path) -> None:
    runs = tiny_runs(tmp_path, scenarios=["buttons", "buttons_8"], seeds=[0, 3])
    assert [run.name for run in runs] == [
        *("buttons/qmix-s0", "buttons/adaptive-s0", "buttons_8/qmix-s0", "buttons_8/adaptive-s0"),
        *("buttons/qmix-s3", "buttons/adaptive-s3", "buttons_8/qmix-s3", "buttons_8/adaptive-s3"),
    ]
    last = runs[-1].config
    assert (last.scenario, last.seed, last.coach.strategy) == ("buttons_8", 3, "adaptive")
    assert (last.n_envs, last.learner.hidden, last.coach.settings.rho) == (5, 16, 0.3)
    assert last.epsilon_anneal_steps == 50_000  # of the configuration


def test_a_report_reads_the_method_from_the_folder(tmp_path: Path) -> None:
    for run in tiny_runs(tmp_path):
        path = Path(run.name)
        assert method_name(path, run.config.scenario, {}) == path.name.removesuffix("-s0")


def test_a_grid_is_every_combination(tmp_path: Path) -> None:
    grid = {"coach.adaptive.beta": [0.6, 0.75], "coach.adaptive.rho": [0.001, 0.3]}
    runs = tiny_runs(tmp_path, config="buttons/adaptive", methods={}, grid=grid)
    assert [run.name for run in runs] == [
        "buttons/beta_0.6-rho_0.001-s0",
        "buttons/beta_0.6-rho_0.3-s0",
        "buttons/beta_0.75-rho_0.001-s0",
        "buttons/beta_0.75-rho_0.3-s0",
    ]
    assert (runs[2].config.coach.settings.beta, runs[2].config.coach.settings.rho) == (0.75, 0.001)


def test_a_size_counts_over_the_rest(tmp_path: Path) -> None:
    small = {"seeds": [7], "methods": ["adaptive"], "set": {"n_envs": 2, "coach.adaptive.rho": 0.5}}
    path = write_sweep(tmp_path / "sweep.yaml", sizes={"small": small})
    (run,) = load_sweep(path, "small")
    assert run.name == "buttons/adaptive-s7"
    assert (run.config.n_envs, run.config.coach.settings.rho, run.config.test_episodes) == (
        2,
        0.5,
        4,
    )
    assert len(load_sweep(path)) == 2


def test_settings_of_a_scenario_count_over_those_of_all(tmp_path: Path) -> None:
    """set < methods < scenario_set, and those of the size over all of them."""
    path = write_sweep(
        tmp_path / "sweep.yaml",
        scenarios=["buttons", "buttons_8"],
        scenario_set={"buttons_8": {"coach.adaptive.rho": 0.4, "n_envs": 3, "test_episodes": 7}},
        sizes={
            "small": {
                "methods": ["adaptive"],
                "set": {"n_envs": 2, "total_steps": 500},
                "scenario_set": {"buttons": {"total_steps": 300}},
            }
        },
    )

    def settings(size: str) -> dict[str, tuple[float, ...]]:
        return {
            run.name: (c.coach.settings.rho, c.n_envs, c.test_episodes, c.total_steps)
            for run in load_sweep(path, size)
            for c in [run.config]
            if c.coach.strategy == "adaptive"
        }

    assert settings("full") == {
        "buttons/adaptive-s0": (0.3, 5, 4, 2000),
        "buttons_8/adaptive-s0": (0.4, 3, 7, 2000),
    }
    assert settings("small") == {
        "buttons/adaptive-s0": (0.3, 2, 4, 300),
        "buttons_8/adaptive-s0": (0.4, 2, 7, 500),
    }


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scenario_set": {"buttons_9": {}}}, r"sweep\.yaml:\d+: no runs on scenario 'buttons_9'"),
        (
            {"sizes": {"s": {"scenarios": ["buttons_8"], "scenario_set": {"buttons": {}}}}},
            r"sweep\.yaml:\d+: no runs on scenario 'buttons' .*scenarios: buttons_8",
        ),
        (
            {"scenario_set": {"buttons": {"coach.betta": 1}}},
            r"sweep\.yaml:\d+: unknown key 'betta' of the coach.*'adaptive.beta'",
        ),
        ({"setings": {}}, r"sweep\.yaml:\d+: unknown key 'setings' .*did you mean 'set'"),
        ({"seeds": []}, r"sweep\.yaml:\d+: seeds = \[\]"),
        ({"seeds": [1, 2, 1]}, "two runs are called buttons/qmix-s1"),
        ({"seeds": [-1]}, r"sweep\.yaml:18: seed = -1"),
        ({"config": "buttons/qmx"}, r"sweep\.yaml:1: no training config 'buttons/qmx'"),
        ({"scenarios": ["butons"]}, "unknown scenario 'butons'.*did you mean 'buttons'"),
        ({"set": {"coach.betta": 1}}, r"sweep\.yaml:3: unknown key 'betta' .*'adaptive.beta'"),
        ({"set": {"n_envs.x": 1}}, r"sweep\.yaml:3: 'n_envs' is a value"),
        ({"set": {"seed": 1}}, r"sweep\.yaml:3: seed is no setting of a sweep: use seeds"),
        ({"methods": {"a": {"n_envs": 0}}}, r"sweep\.yaml:\d+: n_envs = 0: .*greater than"),
        ({"methods": {"a": {}, "b": {}}}, "buttons/a-s0 and buttons/b-s0 are one and the same"),
        ({"methods": {"a/b": {}}}, "method 'a/b' cannot be a folder's name"),
        ({"methods": {"a-s1": {}}}, "method 'a-s1' cannot be a folder's name"),
        ({"methods": {}}, "neither methods nor a grid"),
        ({"methods": {"a": {"coach.min_alive": 9}}}, r"buttons/a-s0: .*min_alive"),
        ({"sizes": {"full": {}}}, r"sweep\.yaml:\d+: 'full' is what stands outside sizes"),
        ({"sizes": {"s": {"methods": ["qmx"]}}}, "unknown method 'qmx' .*did you mean 'qmix'"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        tiny_runs(tmp_path, **changes)


def test_an_unknown_size_or_sweep_is_refused(tmp_path: Path) -> None:
    path = write_sweep(tmp_path / "sweep.yaml", sizes={"small": {}})
    with pytest.raises(ConfigError, match="no size 'tiny'; known: full, small"):
        load_sweep(path, "tiny")
    with pytest.raises(ConfigError, match=r"no sweep 'paper/tabel1' \(did you mean 'paper/table1'"):
        find_sweep("paper/tabel1")


@pytest.mark.parametrize("size", ["full", "small"])
@pytest.mark.parametrize("name", [name for name in sweep_names() if name.startswith("paper/")])
def test_the_papers_sweeps_can_be_read(name: str, size: str) -> None:
    runs = load_sweep(find_sweep(name), size)
    seeds = {run.config.seed for run in runs}
    assert len(seeds) == 5 if size == "full" else len(seeds) >= 3
    assert {run.config.total_steps for run in runs} == {2_000_000} or size == "small"


@pytest.mark.parametrize(
    ("name", "size", "methods", "seeds"),
    [
        ("robust", "full", 1, 20),
        ("share", "full", 4, 20),
        ("ablation", "full", 5, 10),
        ("combat", "full", 11, 5),
        ("combat", "3s_vs_5z", 10, 5),
        ("combat", "3s5z_vs_3s5z", 10, 5),
        ("combat", "8m_vs_5z", 10, 5),
        ("combat", "8m_vs_5z_long", 5, 5),
        ("combat", "3s5z_vs_3s5z_long", 4, 5),
    ],
)
def test_the_recipes_sweeps_give_every_method_the_same_learner(
    name: str, size: str, methods: int, seeds: int
) -> None:
    runs = load_sweep(find_sweep(f"recipe/{name}"), size)
    assert len(runs) == methods * seeds
    learners = {run.config.learner for run in runs}
    assert len(learners) == (2 if name == "ablation" else 1)  # one ablation is without lambda


def test_table1_is_the_papers() -> None:
    shipped = ("ablation", "combat", "coverage", "one_step", "robust", "share")
    papers = ("paper/gridworld", "paper/table1", "paper/table2")
    assert sweep_names() == (*papers, *(f"recipe/{name}" for name in shipped))
    assert not set(sweep_names()) & set(train_config_names())
    runs = load_sweep(find_sweep("paper/table1"))
    assert len(runs) == 7 * 4 * 5
    coaches = {run.name.split("/")[1]: run.config.coach for run in runs if run.config.seed == 0}
    assert {name: (c.strategy, c.crash_rate, c.resample) for name, c in coaches.items()} == {
        "qmix-s0": ("none", 0, False),
        "fix-0.01-s0": ("fixed", 0.01, False),
        "fix-0.05-s0": ("fixed", 0.05, False),
        "fix-0.10-s0": ("fixed", 0.1, False),
        "curriculum-s0": ("curriculum", 0, False),
        "adaptive-unsampled-s0": ("adaptive", 0, False),
        "adaptive-s0": ("adaptive", 0, True),
    }
    assert {c.crash_mode for c in coaches.values()} == {"random"}


def test_the_example_in_the_documents_is_a_sweep(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "sweeps.md").read_text()
    (example,) = re.findall(r"```yaml\n(.*?)```", page, flags=re.DOTALL)
    (tmp_path / "mine.yaml").write_text(example)
    runs = load_sweep(tmp_path / "mine.yaml")
    assert len(runs) == 4 * 2 * 3
    assert runs[3].name == "3m/strategy_adaptive-beta_0.7-s0"
    assert len(load_sweep(tmp_path / "mine.yaml", "quick")) == 2 * 2
