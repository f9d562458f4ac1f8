"""`crash-coach collect` and `report`: which runs, which methods, what the tables say, resuming."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from report_cases import results_of, write_run

from crash_coach_bringup.cli.figure_style import FORMATS
from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.report.verb import asked, report
from crash_coach_common.contract import UserError
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run_dir import RunError, prepare_run


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods with three seeds each."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        write_run(folder / f"qmix-s{seed}", seed=seed)
        vdn = {"algorithm": "vdn"}
        write_run(folder / f"vdn-s{seed}", seed=seed + 10, learner=vdn)
    return folder


def test_report_of_two_methods(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "report"
    report([runs], out=out, episodes=16, crashed=[0, 1], crash_rate=[0.1])
    figures = [
        f"{name}.{kind}" for name in ("success", "resilience", "improvement") for kind in FORMATS
    ]
    assert all((out / name).stat().st_size > 500 for name in ("table.md", "results.json", *figures))
    found = results_of(out)
    assert [(row["condition"], row["method"], row["seeds"]) for row in found["rows"]] == [
        (condition, method, seeds)
        for condition in (
            *("crash-free", "1 crashed", "rate 0.1"),
            *("rate 0.1, re-weighted", "mean over k = 0, 1"),
        )
        for method, seeds in (("qmix", [0, 1, 2]), ("vdn", [10, 11, 12]))
    ]
    for row in found["rows"]:
        mean = sum(row["success"]) / 3
        assert row["interval"]["low"] <= mean <= row["interval"]["high"]
    reweighted = found["rows"][7]
    free, one = (found["rows"][k]["success"] for k in (1, 3))
    # Two robots: both crashed was not measured and counts as a failure.
    expected = [0.81 * a + 0.18 * b for a, b in zip(free, one, strict=True)]
    assert reweighted["success"] == pytest.approx(expected)
    assert reweighted["not_measured"] == pytest.approx(0.01)
    assert {each["condition"] for each in found["improvements"]} == {
        "crash-free", "1 crashed", "rate 0.1",
    }  # fmt: skip
    assert found["runs"][0]["wall_s"] == 80.0
    text = (out / "table.md").read_text()
    overview = text.split("### buttons\n")[1].splitlines()
    columns = ["method", *dict.fromkeys(row["condition"] for row in found["rows"])]
    assert overview[1] == f"| {' | '.join(columns)} |"
    cells = [line.strip("| ").split(" | ") for line in overview[3:5]]
    assert [line[0] for line in cells] == ["qmix", "vdn"]
    means = [sum(row["success"]) / 3 for row in found["rows"]]
    for place, mean in enumerate(means):
        condition, method = divmod(place, 2)
        assert cells[method][1 + condition].strip("*").startswith(f"{100 * mean:.1f} ± ")
        is_best = mean > min(means[2 * condition : 2 * condition + 2])
        assert cells[method][1 + condition].startswith("**") == is_best
    assert "not measured (probability 1.0 %) count as failures" in text
    assert text in capsys.readouterr().out


def test_differences_of_runs_with_the_same_seed(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / f"qmix-s{seed}", seed=seed)
        write_run(tmp_path / f"vdn-s{seed}", seed=seed, learner={"algorithm": "vdn"})
    asked = {"episodes": 16, "crashed": [0], "crash_rate": [0.5]}
    report([tmp_path], out=tmp_path / "report", against=["qmix"], **asked)
    found = results_of(tmp_path / "report")
    conditions = ("crash-free", "rate 0.5", "rate 0.5, re-weighted")
    differences = found["paired_differences"]
    assert [each["condition"] for each in differences] == list(conditions)
    text = (tmp_path / "report" / "table.md").read_text()
    section = text.split("## Differences\n")[1].split("\n## Intervals")[0]
    for place, (condition, each) in enumerate(zip(conditions, differences, strict=True)):
        qmix, vdn = found["rows"][2 * place]["success"], found["rows"][2 * place + 1]["success"]
        assert each["values"] == pytest.approx([b - a for a, b in zip(qmix, vdn, strict=True)])
        mean = f"{50 * (sum(vdn) - sum(qmix)):+.1f}".replace("-", "−")
        table = section.split(f"### {condition}\n")[1].strip().splitlines()
        assert table[0] == "| difference | buttons |"
        assert table[2].startswith(f"| vdn − qmix | {mean} ± ")
    shutil.rmtree(tmp_path / "vdn-s1")
    report([tmp_path], out=tmp_path / "report", against=["qmix"], **asked)
    assert "None: no two methods have 2 seeds" in (tmp_path / "report" / "table.md").read_text()
    with pytest.raises(CliError, match="--against iql: no such method; there are qmix, vdn"):
        report([tmp_path], out=tmp_path / "report", against=["qmix", "iql"], **asked)


def test_it_goes_on_where_it_was_left_and_repeats_every_digit(
    runs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    one = runs / "qmix-s1"
    report([one], out=first, episodes=4, crashed=[0])
    capsys.readouterr()
    report([one], out=first, episodes=4, crashed=[1, 0])
    assert f"{one} on buttons: 1 crashed" in (said := capsys.readouterr().out)
    assert f"{one} on buttons: crash-free" not in said
    report([one], out=second, episodes=4, crashed=[1, 0])
    for name in ("table.md", "results.json", "resilience.svg"):
        assert (first / name).read_bytes() == (second / name).read_bytes()

    # Other weights under the same name, other episodes: nothing old is taken for them.
    capsys.readouterr()
    report([one], out=first, episodes=5, crashed=[0])
    assert "crash-free" in capsys.readouterr().out.splitlines()[0]
    (first / "evaluations" / "qmix-s1.json").write_text('{"a": {"successes": 1}}')
    with pytest.raises(RunError, match=r"qmix-s1\.json is damaged, delete it"):
        report([one], out=first, episodes=5, crashed=[0])


def test_a_single_seed_has_wilsons_interval(runs: Path, tmp_path: Path) -> None:
    report([runs / "vdn-s0"], out=tmp_path, episodes=8, crashed=[1, 0])
    row, free, _ = results_of(tmp_path)["rows"]
    assert row["iqm"] is None
    assert (row["alike"], free["alike"], free["interval"]) == (False, True, None)
    assert row["interval"]["high"] - row["interval"]["low"] > 0.2
    text = (tmp_path / "table.md").read_text()
    assert "Wilson's interval over its episodes" in text
    assert "## Methods" not in text
    assert "they are one episode" in text


def test_one_episode_per_run_counts_over_seeds(runs: Path, tmp_path: Path) -> None:
    folders = [runs / f"qmix-s{seed}" for seed in range(3)]
    report(folders, out=tmp_path, episodes=1, crashed=[0], each_robot=True, mode="stay")
    found = results_of(tmp_path)["rows"]
    assert [row["condition"] for row in found] == [
        "crash-free", "robot_1 stay", "robot_2 stay", "worst victim",
    ]  # fmt: skip
    # Wilson over three seeds, not Student's t, which has no width here.
    assert found[0]["success"] == [0.0] * 3
    assert found[0]["interval"]["high"] == pytest.approx(0.5615, abs=1e-4)


def test_who_hurts_most(runs: Path, tmp_path: Path) -> None:
    folders = [runs / f"{method}-s{seed}" for method in ("qmix", "vdn") for seed in range(3)]
    report(folders, out=tmp_path, episodes=6, crashed=[0, 1], each_robot=True, mode="random")
    found = results_of(tmp_path)
    rows = {(row["condition"], row["method"]): row for row in found["rows"]}
    mean, worst = rows["mean over k = 0, 1", "vdn"], rows["worst victim", "vdn"]
    both = [rows[condition, "vdn"]["success"] for condition in ("crash-free", "1 crashed")]
    assert mean["success"] == pytest.approx([(a + b) / 2 for a, b in zip(*both, strict=True)])
    alone = [rows[f"robot_{i} random", "vdn"]["success"] for i in (1, 2)]
    assert worst["success"] == [min(pair) for pair in zip(*alone, strict=True)]
    (first, *_) = found["costs"]
    free = rows["crash-free", first["method"]]["success"]
    with_it = rows[f"{first['victim']} random", first["method"]]["success"]
    assert first["values"] == pytest.approx([a - b for a, b in zip(free, with_it, strict=True)])
    text = (tmp_path / "table.md").read_text()
    assert "| method | crash-free | 1 crashed | mean over k = 0, 1 | worst victim |" in text
    section = text.split("## Who hurts most")[1].split("## Intervals")[0]
    assert section.count("\n| robot_") == 2
    assert (tmp_path / "victims.png").stat().st_size > 500


def test_maps_are_also_taken_together(tmp_path: Path) -> None:
    for scenario in ("buttons", "coverage"):
        for seed in range(2):
            write_run(tmp_path / f"{scenario}-s{seed}", scenario, seed)
    report([tmp_path], out=tmp_path / "report", episodes=2, crashed=[0], trajectories=None)
    found = results_of(tmp_path / "report")["rows"]
    names = [(row["scenario"], row["method"]) for row in found]
    assert names == [("buttons", "qmix"), ("coverage", "qmix"), ("all maps", "qmix")]
    assert found[2]["interval"] is None
    assert found[2]["iqm"] is not None
    with pytest.raises(CliError, match="--trajectories 0: runs of that seed on one map; found: b"):
        report([tmp_path], out=tmp_path / "report", episodes=2, crashed=[0], trajectories=0)


def test_runs_that_have_just_begun_are_left_out_and_named(tmp_path: Path) -> None:
    write_run(tmp_path / "qmix-s0")
    shutil.rmtree(write_run(tmp_path / "qmix-s1", seed=1) / "checkpoints")
    report([tmp_path], out=tmp_path / "report", episodes=2, crashed=[0])
    text = (tmp_path / "report" / "table.md").read_text()
    assert f"{tmp_path / 'qmix-s1'} has no checkpoint yet: left out." in text
    assert [row["seeds"] for row in results_of(tmp_path / "report")["rows"]] == [[0]]


def test_unfinished_runs_and_uneven_lengths_are_named(tmp_path: Path) -> None:
    write_run(tmp_path / "qmix-s0", steps=100)
    write_run(tmp_path / "qmix-s1", seed=1)
    report([tmp_path], out=tmp_path / "report", episodes=2, crashed=[0])
    text = (tmp_path / "report" / "table.md").read_text()
    assert f"{tmp_path / 'qmix-s0'} is not finished: 100 of 200 steps." in text
    assert "The seeds of qmix on buttons were not trained alike: 100, 200 steps." in text


@pytest.mark.parametrize(
    ("crashed", "rates", "each_robot", "names"),
    [
        (
            None, None, False,
            ["crash-free", "1 crashed", "2 crashed", "rate 0.01", "rate 0.05", "rate 0.1"],
        ),
        (
            None, None, None,
            ["crash-free", "1 crashed", "2 crashed", "rate 0.01", "rate 0.05", "rate 0.1",
             "robot_1 mute", "robot_2 mute"],
        ),
        ([1, 0], None, None, ["1 crashed", "crash-free"]),
        (None, [0.3], None, ["rate 0.3"]),
        ([1], None, True, ["crash-free", "1 crashed", "robot_1 mute", "robot_2 mute"]),
        ([0], [0.3], True, ["crash-free", "rate 0.3", "robot_1 mute", "robot_2 mute"]),
    ],
)  # fmt: skip
def test_conditions(
    crashed: Sequence[int] | None,
    rates: Sequence[float] | None,
    each_robot: bool | None,
    names: list[str],
) -> None:
    found = asked(("robot_1", "robot_2"), crashed, rates, each_robot, "mute", {})
    assert [condition.name for condition in found] == names


def test_bad_input(runs: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    blocked = tmp_path / "blocked"
    blocked.write_text("a file")
    bare = tmp_path / "bare-s0"
    prepare_run(bare, TrainConfig.model_validate({"scenario": "buttons"}), resume=False)
    one = runs / "qmix-s0"
    cases: list[tuple[list[Path], dict[str, Any], str]] = [
        ([], {}, "nothing to report on"),
        ([empty], {}, r"neither a run nor a folder of runs"),
        ([tmp_path / "none"], {}, r"neither a run nor a folder of runs"),
        ([bare], {}, r"none of 1 runs has a checkpoint yet, as .*bare-s0"),
        ([one], {"crashed": [3]}, "--crashed 3: the team has 2 robots"),
        ([one], {"crash_rate": [2.0]}, "--crash-rate 2"),
        ([one], {"mode": "sulk"}, "--mode sulk"),
        ([one], {"out": blocked}, "--out .*blocked: File exists"),
    ]
    for folders, options, text in cases:
        arguments = {"out": tmp_path / "report", "episodes": 2, "crashed": [0], **options}
        with pytest.raises(UserError, match=text):
            report(folders, **arguments)
