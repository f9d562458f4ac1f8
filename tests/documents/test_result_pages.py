"""The figures on docs/results that the runs under results/ tell without being played again."""

from __future__ import annotations

from pathlib import Path

import pytest

from crash_coach_bringup.cli.report.page import coping_table
from policy_pkg.report.coping import Coping, coping
from policy_pkg.report.finished_runs import find_runs, read_runs
from policy_pkg.report.kept_evaluations import Result
from policy_pkg.report.training import training_of

ROOT = Path(__file__).resolve().parents[2]
PAGES = ROOT / "docs" / "results"


def found(sweep: str) -> list[Coping]:
    runs = read_runs(find_runs([ROOT / "results" / "recipe" / sweep]))
    return coping([Result(run, [], training_of(run)) for run in runs])


@pytest.mark.parametrize("sweep", ["robust", "share", "ablation"])
def test_when_they_cope(sweep: str) -> None:
    """The page has every row that `crash-coach report` makes of the folder, as it makes it."""
    lines = coping_table(found(sweep)).splitlines()
    page = (PAGES / "gridworld.md").read_text().splitlines()
    assert [line for line in lines if line not in page] == []


def test_who_copes_on_coverage() -> None:
    page = " ".join((PAGES / "coverage.md").read_text().split())
    ended = {each.method: f"{sum(each.at_end)} of {len(each.seeds)}" for each in found("coverage")}
    words = f"at the end are {ended['robust']} (12..77 %) against {ended['qmix-robust']} (0..43 %)"
    assert words in page
