"""`crash-coach collect`: what it keeps, what it never removes."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest
from report_cases import write_run

from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.report.verb import report
from crash_coach_bringup.cli.verbs.collect import collect
from policy_pkg.report.finished_runs import wall_time_s
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run_dir import RunError, prepare_run


def test_collect_keeps_what_a_report_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = write_run(tmp_path / "runs" / "qmix-s0")
    write_run(tmp_path / "runs" / "qmix-s1", seed=1, steps=150)
    prepare_run(
        tmp_path / "runs" / "qmix-s2",
        TrainConfig.model_validate({"scenario": "buttons"}),
        resume=False,
    )
    kept = tmp_path / "results" / "qmix-s0"
    for _ in range(2):  # a copy made before is replaced
        collect(tmp_path / "runs", tmp_path / "results")
    said = capsys.readouterr().out
    assert "qmix-s1: not finished: checkpoint at 150 of 200 steps" in said
    assert "qmix-s2: not finished: checkpoint at 0 of" in said
    assert [path.name for path in kept.parent.iterdir()] == ["qmix-s0"]
    assert (
        gzip.decompress((kept / "timing.jsonl.gz").read_bytes())
        == (run / "timing.jsonl").read_bytes()
    )
    assert wall_time_s(kept) == wall_time_s(run) == 80.0

    for folder, out in ((run, tmp_path / "a"), (kept, tmp_path / "b")):
        report([folder], out=out, episodes=2, crashed=[0, 1])
    strip = [
        (folder / "table.md").read_text().replace(str(run), str(kept))
        for folder in (tmp_path / "a", tmp_path / "b")
    ]
    assert strip[0] == strip[1]


def test_collect_never_removes_what_is_no_copy(tmp_path: Path) -> None:
    run = write_run(tmp_path / "runs" / "qmix-s0")
    mine = tmp_path / "results" / "qmix-s0"
    mine.mkdir(parents=True)
    (mine / "thesis.tex").write_text("years of work")
    for results in (tmp_path / "results", run.parent):
        with pytest.raises(RunError, match="choose another folder for the results"):
            collect(run, results)
    assert (mine / "thesis.tex").exists()
    assert (run / "checkpoints").exists()
    write_run(tmp_path / "other" / "qmix-s0", steps=1)
    with pytest.raises(CliError, match="none of its runs is finished"):
        collect(tmp_path / "other", tmp_path / "new")
