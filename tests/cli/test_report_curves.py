"""Learning curves of a report: what is read, averaged and drawn."""

from __future__ import annotations

import gzip
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from crash_coach_bringup.cli.report.curves import (
    Curve,
    learning_curves,
    mean_curve,
    read_curve,
    running_mean,
)
from policy_pkg.report.finished_runs import Run
from policy_pkg.train.run_dir import RunError


def run(
    folder: Path, rows: Sequence[dict[str, float | None]], scenario: str = "buttons", seed: int = 0
) -> Run:
    folder.mkdir(parents=True)
    text = "".join(json.dumps(row) + "\n" for row in rows)
    (folder / "metrics.jsonl.gz").write_bytes(gzip.compress(text.encode()))
    return Run(
        folder, folder / "checkpoints/step_100", "qmix", scenario, seed, {}, 100, 100, "", scenario
    )


def block(steps: int, success: float | None, axis: str = "env_steps") -> dict[str, float | None]:
    return {axis: steps, "success_crash_free": success}


def test_running_mean_takes_what_there_is() -> None:
    values = np.array([1.0, 0.0, 0.0, 1.0, 1.0])
    assert running_mean(values, 3) == pytest.approx([1, 1 / 2, 1 / 3, 1 / 3, 2 / 3])
    assert running_mean(values, 1) == pytest.approx(values)


def test_blocks_with_crashes_are_left_out_and_recordings_have_gradient_steps(
    tmp_path: Path,
) -> None:
    curve = read_curve(run(tmp_path / "a", [block(0, 0.0), block(5, None), block(10, 1.0)]))
    assert curve is not None
    assert (curve.axis, curve.steps.tolist(), curve.success.tolist()) == (
        "env_steps",
        [0, 10],
        [0, 1],
    )
    offline = read_curve(
        run(tmp_path / "b", [block(k, 0.5, "gradient_steps") for k in (0, 10, 20)])
    )
    assert offline is not None
    assert offline.axis == "gradient_steps"
    assert read_curve(run(tmp_path / "c", [block(0, None), block(5, None)])) is None


def test_the_mean_goes_as_far_as_all_runs(tmp_path: Path) -> None:
    curves = [
        Curve(run(tmp_path / "a", []), "env_steps", np.array([0.0, 10, 20]), np.zeros(3)),
        Curve(run(tmp_path / "b", []), "env_steps", np.array([0.0, 20, 40]), np.ones(3)),
    ]
    steps, mean = mean_curve(curves)
    assert steps.tolist() == [0, 10, 20]
    assert mean == pytest.approx([0.5, 0.5, 0.5])


def test_a_panel_per_map_with_every_seed_and_their_mean(tmp_path: Path) -> None:
    rows = [block(k, 0.1 * k) for k in range(5)]
    runs = [run(tmp_path / f"buttons-s{seed}", rows, seed=seed) for seed in range(3)]
    runs.append(run(tmp_path / "3m-s0", rows, "skirmish/3m"))
    figure = learning_curves(runs, ["qmix"])
    assert figure is not None
    assert [ax.get_title() for ax in figure.axes] == ["buttons", "skirmish/3m"]
    assert [len(ax.get_lines()) for ax in figure.axes] == [3 + 1, 1]
    assert learning_curves([run(tmp_path / "none", [])], ["qmix"]) is None


def test_damaged_metrics_are_named(tmp_path: Path) -> None:
    broken = run(tmp_path / "a", [])
    (broken.path / "metrics.jsonl.gz").write_bytes(b"no gzip")
    with pytest.raises(RunError, match=r"metrics\.jsonl\.gz cannot be read"):
        read_curve(broken)
