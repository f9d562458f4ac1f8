"""docs/faults.md against the schemas, and its command lines against the coach's parameters."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from crash_coach_bringup.cli.faults.docs import BLOCK, SET_LINES, generated, update
from crash_coach_bringup.cli.faults.verb import app
from crash_coach_bringup.cli.output import CliError
from crash_coach_pkg.coach.config import FaultConfig
from crash_coach_pkg.coach.expectations import Expectation
from crash_coach_pkg.coach.fault_scenario import load_fault_scenario
from crash_coach_pkg.coach.parameters import build_settings, check_change, parameter_specs
from crash_coach_pkg.faults import fault_mode, mode_names
from crash_coach_pkg.team import TeamSpec

PAGE = Path(__file__).resolve().parents[2] / "docs" / "faults.md"
TEAM = TeamSpec(("robot_1", "robot_2"), ("robot", "robot"), 0.5)
LINES = re.findall(r"ros2 param set (\S+) (\S+) ([^`\n]+)", PAGE.read_text())


def test_the_page_is_what_the_schemas_say() -> None:
    page = PAGE.read_text()
    assert update(page) == page, "run: crash-coach faults docs --page docs/faults.md"


def test_an_outdated_page_is_mended_and_a_broken_one_refused() -> None:
    page = PAGE.read_text()
    old = BLOCK.sub(lambda m: f"{m.group(1)}old\n{m.group(3)}", page)
    assert old != page
    assert update(old) == page
    with pytest.raises(CliError, match="once each: modes, settings, file, expectations"):
        update(page.replace("<!-- generated: modes -->", ""))


def test_the_verb_prints_the_tables_or_mends_a_page(tmp_path: Path) -> None:
    done = CliRunner().invoke(app, ["docs"])
    assert done.exit_code == 0
    assert all(block in done.output for block in generated().values())
    page = tmp_path / "faults.md"
    page.write_text(BLOCK.sub(lambda m: f"{m.group(1)}old\n{m.group(3)}", PAGE.read_text()))
    assert CliRunner().invoke(app, ["docs", "--page", str(page)]).exit_code == 0
    assert page.read_text() == PAGE.read_text()
    for content, names in ((b"\xff", "not UTF-8"), (b"no blocks", "generated blocks none")):
        page.write_bytes(content)
        done = CliRunner().invoke(app, ["docs", "--page", str(page)])
        assert isinstance(done.exception, CliError)
        assert names in str(done.exception)
        assert page.read_bytes() == content


def test_every_mode_parameter_setting_and_expectation_is_there() -> None:
    blocks = generated()
    for mode in mode_names():
        assert f"### `{mode}`" in blocks["modes"]
        assert any(name == "crash_mode" and value == mode for _, name, value in LINES)
        for parameter in fault_mode(mode).Parameters.model_fields:
            assert any(name == f"{mode}.{parameter}" for _, name, _ in LINES)
    for name in FaultConfig.model_fields:
        assert f"| `{name}` |" in blocks["settings"]
    assert set(FaultConfig.model_fields) - set(SET_LINES) == {"crash_parameters"}
    for name in Expectation.model_fields:
        assert f"| `{name}` |" in blocks["expectations"]


@pytest.mark.parametrize(("node", "name", "typed"), LINES)
def test_each_command_line_sets_a_parameter_within_its_range(
    node: str, name: str, typed: str
) -> None:
    assert node == "/coach"
    (spec,) = (spec for spec in parameter_specs() if spec.name == name)
    value = yaml.safe_load(typed.strip('"'))  # as `ros2 param set` reads it
    kind = type(spec.default)
    if kind is tuple:
        value = tuple(value)
    assert type(value) is kind, f"{name}: {value!r} is no {kind.__name__}"
    if spec.low is not None and spec.high is not None:
        assert spec.low <= value <= spec.high
    values = {s.name: s.default for s in parameter_specs()}
    check_change(build_settings({**values, name: value}, TEAM), [name])


def test_the_example_is_a_fault_scenario_that_fits(tmp_path: Path) -> None:
    (text,) = re.findall(r"```yaml\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    path = tmp_path / "example.yaml"
    path.write_text(text)
    scenario = load_fault_scenario(path)
    assert scenario.expect
    scenario.check(TeamSpec(("robot_1", "robot_2", "robot_3", "robot_4"), (), 0.5), 80)
