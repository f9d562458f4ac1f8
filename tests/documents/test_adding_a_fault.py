"""docs/adding_a_fault.md, followed to the letter: a mode of a package that is not ours."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from page_package import Page, crash_coach, refused

PAGE = Page("adding_a_fault.md", "The mode")


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return PAGE.installed(tmp_path_factory.mktemp("site"), PAGE.block("toml"))


def hash_of(folder: Path, line: str, out: Path) -> str:
    done = crash_coach(folder, line, "--json", str(out))
    assert done.returncode == 0, done.stderr
    return str(json.loads(out.read_text())["conditions"][-1]["trajectory_hash"])


def test_the_mode_works_as_the_page_says(package: Path, tmp_path: Path) -> None:
    line = PAGE.block("bash").strip()
    frozen = line.replace("--mode hiccup --param period=2", "--mode freeze")
    lines = line, line.replace("period=2", "period=1"), frozen
    as_written, each_step, freeze = (
        hash_of(package, text, tmp_path / f"{i}.json") for i, text in enumerate(lines)
    )
    assert as_written != each_step
    assert each_step == freeze  # from the first step on, nothing new is taken


def test_its_schema_is_checked(package: Path) -> None:
    line = PAGE.block("bash").strip().replace("period=2", "period=0")
    assert "hiccup: parameter period = 0" in refused(package, line)


def test_without_the_package_the_mode_is_unknown(tmp_path: Path) -> None:
    assert "unknown crash mode 'hiccup'" in refused(tmp_path, PAGE.block("bash").strip())


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("hiccup:Hiccup", "hiccup:Hicup", "has no attribute 'Hicup'"),
        ("hiccup:Hiccup", "hiccup:HiccupParameters", "neither a CommandFault nor"),
    ],
)
def test_a_broken_entry_point_is_named(tmp_path: Path, old: str, new: str, text: str) -> None:
    site = PAGE.installed(tmp_path / "site", PAGE.block("toml").replace(old, new))
    said = refused(site, PAGE.block("bash").strip())
    assert "entry point hiccup" in said
    assert "my-faults" in said
    assert text in said
