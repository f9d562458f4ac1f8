"""`crash-coach plot`: curves read, grouped and averaged; pictures; damaged runs refused."""

from __future__ import annotations

import gzip
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from crash_coach_bringup.cli.curves import (
    BOOTSTRAP,
    EACH_CRASHED,
    RANGE,
    TRAINING,
    average,
    bootstrap_mean,
    group_runs,
    load_run,
)
from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.verbs.plot import (
    TITLES,
    draw,
    legend,
    note,
    plot,
    targets,
    wide_enough,
)
from crash_coach_common.contract import UserError
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.run_dir import prepare_run

STEPS = (0, 100, 200)


def write_run(
    folder: Path,
    seed: int = 0,
    success: Sequence[float | None] = (0.0, 0.5, 1.0),
    steps: Sequence[int] = STEPS,
    total_steps: int = 200,
    algorithm: str = "qmix",
) -> Path:
    """A run directory as training leaves it."""
    config = {"scenario": "buttons", "seed": seed, "total_steps": total_steps}
    settings = TrainConfig.model_validate({**config, "learner": {"algorithm": algorithm}})
    prepare_run(folder, settings, resume=False)
    rows = [
        {
            "env_steps": step,
            "success_rate": value,
            "success_crash_free": None,
            "return_mean": -20.0 + step,
            "alpha": 0.25,
        }
        for step, value in zip(steps, success, strict=True)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def write_offline_run(folder: Path, data: str, test_crashed: tuple[int, ...] = (1,)) -> Path:
    """A run on recordings as train-offline leaves it."""
    settings = OfflineConfig(scenario="buttons", gradient_steps=20, test_crashed=test_crashed)
    prepare_run(folder, settings, False, {"sha256": data})
    figures = {f"success_{count}_crashed": 0.25 for count in test_crashed}
    rows = [
        {
            "gradient_steps": steps,
            "success_crash_free": 0.5,
            **figures,
            "return_crash_free": 1.0,
            "loss": None if steps == 0 else 2.0,
        }
        for steps in (0, 10, 20)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def test_what_one_crashed_robot_costs_is_drawn_where_it_was_measured(tmp_path: Path) -> None:
    measured = write_run(tmp_path / "measured-s0")
    lines = [json.loads(line) for line in (measured / "metrics.jsonl").read_text().splitlines()]
    for line, rates in zip(lines, ((0.0, 0.0), (1.0, 0.0), (1.0, 0.5)), strict=True):
        line |= dict(
            zip(("success_robot_1_crashed", "success_robot_2_crashed"), rates, strict=True)
        )
    (measured / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    other = write_run(tmp_path / "other-s0", algorithm="vdn")
    groups = group_runs([load_run(measured), load_run(other)])
    curves = [{key: average(group, key) for key in TRAINING.curves} for group in groups]
    with_it, without = curves
    assert with_it[EACH_CRASHED] is not None
    assert with_it[EACH_CRASHED].mean.tolist() == [0.0, 0.5, 0.75]
    assert without[EACH_CRASHED] is None
    titles = [ax.get_title() for ax in draw(groups, curves).axes]
    assert titles[3] == f"{TITLES[EACH_CRASHED]}\nnot measured: other"
    assert not any("return" in title for title in titles)
    assert any("return" in ax.get_title() for ax in draw(groups[1:], curves[1:]).axes)


def test_runs_on_recordings_are_drawn_by_gradient_steps(tmp_path: Path) -> None:
    paths = [write_offline_run(tmp_path / data / "qmix-s0", data) for data in ("one", "two")]
    plot(paths, tmp_path / "curves", tmp_path / "curves.json")
    groups = json.loads((tmp_path / "curves.json").read_text())["groups"]
    assert [group["label"] for group in groups] == ["one/qmix", "two/qmix"]
    assert groups[0]["runs"][0]["finished"]
    assert groups[0]["curves"]["loss"]["gradient_steps"] == [10, 20]
    assert groups[0]["curves"]["success_1_crashed"]["mean"] == [0.25] * 3
    without = load_run(write_offline_run(tmp_path / "three" / "qmix-s0", "three", (2,)))
    (group,) = group_runs([without])
    assert average(group, "success_1_crashed") is None
    with pytest.raises(CliError, match="in two figures"):
        group_runs([without, load_run(write_run(tmp_path / "vdn-s0"))])


def test_groups_by_config_without_seed(tmp_path: Path) -> None:
    paths = [
        write_run(tmp_path / "vdn-s7", 7, algorithm="vdn"),
        write_run(tmp_path / "qmix-s2", 2),
        write_run(tmp_path / "qmix-s1", 1),
    ]
    groups = group_runs([load_run(path) for path in paths])
    assert [group.label for group in groups] == ["vdn", "qmix"]
    assert [[run.seed for run in group.runs] for group in groups] == [[7], [1, 2]]
    assert [group.band for group in groups] == [None, RANGE]


def test_labels_that_clash_name_the_folder_above_or_the_path(tmp_path: Path) -> None:
    one = write_run(tmp_path / "a" / "qmix-s0")
    other = write_run(tmp_path / "b" / "qmix-s0", total_steps=300)
    groups = group_runs([load_run(one), load_run(other)])
    assert [group.label for group in groups] == ["a/qmix", "b/qmix"]
    sibling = write_run(tmp_path / "a" / "qmix-s1", 1, total_steps=300)
    groups = group_runs([load_run(one), load_run(sibling)])
    assert [group.label for group in groups] == [str(one), str(sibling)]


def test_the_same_run_twice_is_refused(tmp_path: Path) -> None:
    run = load_run(write_run(tmp_path / "qmix-s3", 3))
    with pytest.raises(CliError, match="same config and seed 3"):
        group_runs([run, run])


def test_single_run_is_drawn_as_it_is(tmp_path: Path) -> None:
    (group,) = group_runs([load_run(write_run(tmp_path / "qmix-s0"))])
    curve = average(group, "success_rate")
    assert curve is not None
    assert curve.steps.tolist() == [0, 100, 200]
    assert curve.mean.tolist() == [0.0, 0.5, 1.0]
    assert curve.low is None
    assert curve.high is None


def test_steps_that_differ_are_interpolated_as_far_as_all_runs_reach(tmp_path: Path) -> None:
    long = write_run(tmp_path / "qmix-s0", 0, (0.0, 1.0, 1.0))
    short = write_run(tmp_path / "qmix-s1", 1, (0.0, 1.0), steps=(0, 50))
    (group,) = group_runs([load_run(long), load_run(short)])
    curve = average(group, "success_rate")
    assert curve is not None
    assert curve.low is not None
    assert curve.high is not None
    assert curve.steps.tolist() == [0, 50]
    # At step 50 the long run lies half way between 0 and 1.
    assert curve.mean.tolist() == [0.0, 0.75]
    assert curve.low.tolist() == [0.0, 0.5]
    assert curve.high.tolist() == [0.0, 1.0]
    assert not group.finished
    assert note(group) == "qmix: unfinished: seed 1 at 50 of 200 steps"


def test_a_collected_run_is_drawn_from_its_compressed_metrics(tmp_path: Path) -> None:
    path = write_run(tmp_path / "qmix-s0")
    before = load_run(path)
    packed = path / "metrics.jsonl.gz"
    packed.write_bytes(gzip.compress((path / "metrics.jsonl").read_bytes()))
    (path / "metrics.jsonl").unlink()
    after = load_run(path)
    assert after.steps.tolist() == before.steps.tolist()
    assert after.values["success_rate"].tolist() == [0.0, 0.5, 1.0]
    packed.write_bytes(gzip.compress(b"{"))
    with pytest.raises(CliError, match=r"metrics\.jsonl\.gz:1: damaged line"):
        load_run(path)


def test_points_that_were_not_measured(tmp_path: Path) -> None:
    run = write_run(tmp_path / "qmix-s0", success=(0.0, None, 1.0))
    (group,) = group_runs([load_run(run)])
    curve = average(group, "success_rate")
    assert curve is not None
    assert curve.steps.tolist() == [0, 200]
    assert average(group, "success_crash_free") is None


def test_five_seeds_get_a_bootstrap_interval(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / f"q-s{s}", s, (0.0, 0.2 * s, 1.0)) for s in range(5)]
    (group,) = group_runs([load_run(path) for path in paths])
    assert group.band == BOOTSTRAP
    curve = average(group, "success_rate")
    assert curve is not None
    assert curve.low is not None
    assert curve.high is not None
    assert curve.mean == pytest.approx([0.0, 0.4, 1.0])
    assert curve.low[[0, 2]] == pytest.approx([0.0, 1.0])
    assert 0.0 < curve.low[1] < 0.4 < curve.high[1] < 0.8


def test_bootstrap_agrees_with_the_normal_interval_of_many_seeds() -> None:
    values = np.random.default_rng(5).normal(size=(400, 1))
    low, high = bootstrap_mean(values)
    error = values.std() / np.sqrt(len(values))
    assert low[0] == pytest.approx(values.mean() - 1.96 * error, abs=0.2 * error)
    assert high[0] == pytest.approx(values.mean() + 1.96 * error, abs=0.2 * error)
    assert np.array_equal(bootstrap_mean(values), (low, high))


def texts(figure: Any) -> str:
    from matplotlib.text import Text

    return "\n".join(text.get_text() for text in figure.findobj(Text))


def test_figure_says_what_band_what_is_unfinished_and_not_measured(tmp_path: Path) -> None:
    paths = [write_run(tmp_path / f"five-s{s}", s, total_steps=1000) for s in range(5)]
    paths += [write_run(tmp_path / f"three-s{s}", s, algorithm="vdn") for s in range(3)]
    groups = group_runs([load_run(path) for path in paths])
    keys = ("success_rate", "success_crash_free", "return_mean", "alpha")
    figure = draw(groups, [{key: average(group, key) for key in keys} for group in groups])
    found = texts(figure)
    assert f"five (mean of 5 seeds; band: {BOOTSTRAP})" in found
    assert "three (mean of 3 seeds; band: min..max)" in found
    assert "five: unfinished: seed 0 at 200, seed 1 at 200" in found
    assert "three: unfinished" not in found
    assert "not measured: five, three" in found
    colours = [handle.get_color() for handle in figure.legends[0].get_lines()]
    lines = figure.axes[0].get_lines()
    # The unfinished group has a mark at its end beside its line.
    assert [line.get_color() for line in lines] == [colours[0], colours[0], colours[1]]


def test_writes_both_pictures_and_the_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [write_run(tmp_path / f"qmix-s{seed}", seed) for seed in range(2)]
    stem, result = tmp_path / "v1.2", tmp_path / "curves.json"
    plot(runs, stem, result)
    png, svg = tmp_path / "v1.2.png", tmp_path / "v1.2.svg"
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "</svg>" in svg.read_text()
    shown = capsys.readouterr().out
    assert f"wrote {png}" in shown
    assert f"wrote {svg}" in shown
    (group,) = json.loads(result.read_text())["groups"]
    assert group["label"] == "qmix"
    assert group["band"] == RANGE
    assert [run["seed"] for run in group["runs"]] == [0, 1]
    assert group["curves"]["success_crash_free"] is None
    assert group["curves"]["alpha"]["mean"] == [0.25, 0.25, 0.25]
    before = png.read_bytes(), svg.read_bytes()
    plot(runs, stem)
    assert (png.read_bytes(), svg.read_bytes()) == before
    assert not list(tmp_path.glob("*.partial"))


def test_the_right_end_is_told_of_every_seed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = []
    for seed, end in enumerate((0.5, 0.7)):
        run = write_run(tmp_path / f"qmix-s{seed}", seed, (1.0, 0.0, *[end] * 10), range(12))
        rows = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
        for row in rows:
            row["success_crash_free"] = row["success_rate"]
            row |= {"success_robot_1_crashed": 0.4, "success_robot_2_crashed": end - 0.3}
        rows[-1]["success_crash_free"] = end + 0.1
        (run / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        runs.append(run)
    plot(runs, tmp_path / "curves", tmp_path / "curves.json")
    told = (
        "last 10 blocks: crash-free 61.0 ± 14.1 % (51.0, 71.0); each robot crashed alone 35.0 ± "
        "7.1 % (30.0, 40.0); the one that costs most 30.0 ± 14.1 % (20.0, 40.0)"
    )
    assert told in capsys.readouterr().out
    (group,) = json.loads((tmp_path / "curves.json").read_text())["groups"]
    assert group["last_blocks"]["count"] == 10
    assert group["last_blocks"]["success_percent"]["success_crash_free"] == pytest.approx([51, 71])
    short = write_run(tmp_path / "short-s0", 0, (0.5,) * 9, range(9))
    plot([short], tmp_path / "short")
    assert "last 10 blocks" not in capsys.readouterr().out


def test_out(tmp_path: Path) -> None:
    assert targets(tmp_path / "a.png") == targets(tmp_path / "a")
    (tmp_path / "file").touch()
    with pytest.raises(CliError, match="file is not a folder"):
        targets(tmp_path / "file" / "missing" / "a")
    (tmp_path / "b.svg").mkdir()
    with pytest.raises(CliError, match=r"b\.svg: is a directory"):
        targets(tmp_path / "b")


def test_label_of_a_single_run(tmp_path: Path) -> None:
    (group,) = group_runs([load_run(write_run(tmp_path / "f1", 4))])
    assert legend(group) == "f1 (seed 4)"
    assert note(group) is None


GOOD = '{"env_steps": 0, "success_rate": 0, "success_crash_free": 0, "return_mean": 0, "alpha": 0}'


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "metrics.jsonl is empty"),
        (GOOD + '\n{"env_steps": 10', r"metrics.jsonl:2: damaged line: .* at column"),
        (GOOD + "\n\n", "metrics.jsonl:2: damaged line"),
        ("[1]\n", "metrics.jsonl:1: damaged line: expected an object"),
        ('{"env_steps": 0}\n', "metrics.jsonl:1: damaged line: success_rate is missing"),
        (GOOD.replace('alpha": 0', 'alpha": NaN'), ":1: .* alpha is nan, not a finite number"),
        (GOOD.replace('steps": 0', 'steps": null'), ":1: .* env_steps is None"),
        (f"{GOOD}\n{GOOD}\n", r"metrics.jsonl:2: .* env_steps 0 does not exceed 0"),
    ],
)
def test_damaged_metrics_name_file_and_line(tmp_path: Path, content: str, expected: str) -> None:
    run = write_run(tmp_path / "qmix-s0")
    (run / "metrics.jsonl").write_text(content)
    with pytest.raises(UserError, match=expected) as caught:
        load_run(run)
    assert "\n" not in str(caught.value)


def test_no_run(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="holds no run"):
        load_run(tmp_path)
    run = write_run(tmp_path / "qmix-s0")
    (run / "metrics.jsonl").unlink()
    with pytest.raises(UserError, match=r"metrics\.jsonl is missing"):
        load_run(run)
    with pytest.raises(UserError, match="no run to plot"):
        plot([])


def test_other_verbs_do_not_load_matplotlib() -> None:
    code = (
        "import sys; from crash_coach_bringup.cli.main import make_app; make_app();"
        "sys.exit(any(name.split('.')[0] == 'matplotlib' for name in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=250).returncode == 0


@pytest.mark.parametrize(
    ("limits", "least", "expected"),
    [
        ((-0.05, 0.05), 0.0, (-0.0015, 0.05)),  # a crash rate of 0 throughout
        ((9.9999, 10.0001), 9.9999, (9.5, 10.5)),
        ((-110.0, -60.0), -110.0, (-110.0, -60.0)),
        ((-0.2, 4.2), 0.0, (-0.126, 4.2)),
    ],
)
def test_flat_curves_get_a_quiet_axis_and_rates_none_below_zero(
    limits: tuple[float, float], least: float, expected: tuple[float, float]
) -> None:
    assert wide_enough(limits, least) == pytest.approx(expected)


def test_what_versions_wrote_differently_is_one_method(tmp_path: Path) -> None:
    """A key that a later version added with its default, and what is logged beside."""
    share = Path(__file__).parents[2] / "results" / "recipe" / "share"
    runs = [tmp_path / f"qmix-s{seed}" for seed in (0, 10)]
    for run in runs:
        shutil.copytree(share / run.name, run)
    keys = [json.loads((run / "run.json").read_text())["config"]["learner"].keys() for run in runs]
    assert [("device" in each) for each in keys] == [False, True]
    (group,) = group_runs([load_run(run) for run in runs])
    assert group.label == "qmix"
