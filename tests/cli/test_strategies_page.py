"""docs/strategies.md against the schemas; and that no general code knows a strategy by its name."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from crash_coach_bringup.cli.markdown import table
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.parameters import parameter_specs
from crash_coach_pkg.coach.strategies import find_strategy, settings_of, strategy_names

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs/strategies.md").read_text()
FOLDER = ROOT / "crash_coach_pkg/crash_coach_pkg/coach/strategies"


def strategies_table() -> str:
    rows = [(f"`{name}`", find_strategy(name).summary) for name in strategy_names()]
    return table(("strategy", "who crashes"), rows)


def settings_table() -> str:
    rows = [
        (
            f"`{name}.{info.name}`",
            info.unit,
            f"{info.low:.10g}..{info.high:.10g}",
            f"{info.default:g}",
            info.description,
        )
        for name in strategy_names()
        for info in settings_of(find_strategy(name))
    ]
    return table(("setting", "unit", "range", "default", "meaning"), rows)


@pytest.mark.parametrize("expected", [strategies_table(), settings_table()])
def test_the_page_is_what_the_schemas_say(expected: str) -> None:
    assert expected in PAGE, f"docs/strategies.md has to say:\n{expected}"


def test_its_lines_set_parameters() -> None:
    known = {spec.name for spec in parameter_specs()}
    lines = re.findall(r"ros2 param set /coach (\S+)", PAGE)
    assert lines
    assert set(lines) <= known


def test_no_general_code_compares_a_strategys_name() -> None:
    """Outside the strategies' own files a name is chosen, never asked for."""
    names = set(strategy_names())
    packages = ("crash_coach_pkg", "policy_pkg", "sim_pkg", "ros_ws/src", "scripts", "benchmarks")
    files = [path for package in packages for path in (ROOT / package).rglob("*.py")]
    files = [
        p for p in files if not {"build", "install"} & set(p.parts) and FOLDER not in p.parents
    ]
    assert len(files) > 100
    found = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in files
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Compare) and "strategy" in ast.unparse(node)
        for part in ast.walk(node)
        if isinstance(part, ast.Constant) and part.value in names
    ]
    assert not found


def test_a_strategy_is_a_small_file() -> None:
    for path in FOLDER.glob("*.py"):
        if path.stem in strategy_names():
            assert len(path.read_text().splitlines()) <= 80, path.name


def test_no_setting_of_the_coach_has_a_strategys_name() -> None:
    assert not set(strategy_names()) & set(CoachConfig.model_fields)
