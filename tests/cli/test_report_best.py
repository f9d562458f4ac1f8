"""RUN@best: the best checkpoints, in reports, tables and copies."""

from __future__ import annotations

from pathlib import Path

from in_process import refused
from report_cases import results_of, write_run

from crash_coach_bringup.cli.report.verb import report
from crash_coach_bringup.cli.verbs.collect import collect


def test_best_checkpoints_beside_the_last(tmp_path: Path) -> None:
    for seed in range(2):
        write_run(tmp_path / f"qmix-s{seed}", seed=seed, best=150)
    write_run(tmp_path / "vdn-s0", learner={"algorithm": "vdn"})
    out = tmp_path / "report"
    runs = [tmp_path / f"qmix-s{seed}" for seed in range(2)]
    at_best = [run.with_name(f"{run.name}@best") for run in runs]
    report([*runs, *at_best], out=out, episodes=4, crashed=[0])
    found = results_of(out)
    assert [row["method"] for row in found["rows"]] == ["qmix", "qmix@best"]
    acting = [(run["checkpoint"], run["checkpoint_steps"], run["steps"]) for run in found["runs"]]
    assert acting == [("last", 200, 200)] * 2 + [("best", 150, 200)] * 2
    hashes = [run["outcomes"]["crash-free"]["trajectory_hash"] for run in found["runs"]]
    assert hashes[0] != hashes[2]  # other weights
    text = (out / "table.md").read_text()
    assert "Of runs called METHOD@best" in text
    assert "| buttons | qmix@best | 0 | 200 | best, 150 |" in text
    assert "is not finished" not in text
    # A folder of runs; one that kept none is named.
    report([tmp_path.with_name(f"{tmp_path.name}@best")], out=out, episodes=4, crashed=[0])
    assert f"{tmp_path / 'vdn-s0@best'} has no checkpoint yet" in (out / "table.md").read_text()
    assert [run["checkpoint"] for run in results_of(out)["runs"]] == ["best"] * 2
    assert refused("evaluate", str(tmp_path / "vdn-s0@best")) == (
        f"crash-coach: error: {tmp_path / 'vdn-s0@best'}: {tmp_path / 'vdn-s0'}/best/step_*/ is "
        "not there: the run kept no best checkpoint\n"
    )
    kept = tmp_path / "results"
    collect(runs[0], kept)
    report([kept / "qmix-s0@best"], out=tmp_path / "again", episodes=4, crashed=[0])
    (again,) = results_of(tmp_path / "again")["runs"]
    assert again["outcomes"]["crash-free"]["trajectory_hash"] == hashes[2]
