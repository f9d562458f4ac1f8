"""docs/adding_a_strategy.md, followed to the letter: a strategy of a package that is not ours."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest
from page_package import Page, crash_coach, refused

PAGE = Page("adding_a_strategy.md", "The strategy")
RUN = "runs/weakest"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return PAGE.installed(tmp_path_factory.mktemp("site"), PAGE.block("toml"))


def test_the_strategy_trains_as_the_page_says(package: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    done = crash_coach(package, PAGE.block("bash").strip().replace(RUN, shlex.quote(str(run))))
    assert done.returncode == 0, done.stderr
    described = json.loads((run / "run.json").read_text())["config"]["coach"]
    assert (described["strategy"], described["weakest"]) == ("weakest", {"every": 3})
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    assert [line["alpha"] for line in lines] == [pytest.approx(1 / 6)] * 4
    # One robot of two in a third of the episodes, of which there were some 150.
    fractions = [line["crashed_fraction"] for line in lines[1:]]
    assert sum(fractions) / 3 == pytest.approx(1 / 6, abs=0.08)
    (checkpoint,) = (run / "checkpoints").iterdir()
    state = json.loads((checkpoint / "checkpoint.json").read_text())["training"]["coach"]
    worst = min("robot_1", "robot_2", key=lambda name: lines[-1][f"success_{name}_crashed"])
    assert state["strategy"] == {"robot": int(worst[-1]) - 1}


def test_its_settings_are_checked(package: Path, tmp_path: Path) -> None:
    line = PAGE.block("bash").strip().replace(RUN, shlex.quote(str(tmp_path / "run")))
    for wrong, text in (
        ("every=0", "strategy weakest: setting every = 0: Input should be greater"),
        ("evry=3", "unknown setting 'evry' (did you mean 'every'?)"),
    ):
        assert text in refused(package, line.replace("every=3", wrong))


def test_without_the_package_the_strategy_is_unknown(tmp_path: Path) -> None:
    line = PAGE.block("bash").strip().replace(RUN, shlex.quote(str(tmp_path / "run")))
    assert "unknown key 'weakest' of the coach" in refused(tmp_path, line)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("weakest:Weakest", "weakest:Weekest", "has no attribute 'Weekest'"),
        ("weakest:Weakest", "weakest:WeakestSettings", "is not a Strategy"),
    ],
)
def test_a_broken_entry_point_is_named(tmp_path: Path, old: str, new: str, text: str) -> None:
    site = PAGE.installed(tmp_path / "site", PAGE.block("toml").replace(old, new))
    line = PAGE.block("bash").strip().replace(RUN, shlex.quote(str(tmp_path / "run")))
    said = refused(site, line)
    assert "entry point weakest" in said
    assert "my-strategies" in said
    assert text in said
