"""Bad scenario files: each error names file, line, key and value, and says what is right."""

from __future__ import annotations

from pathlib import Path

import pytest
from bad_files import check_refused
from pydantic import Field

from crash_coach_common.strict_yaml import ConfigError, StrictModel, load_yaml_strict
from sim_pkg.env import make_env, scenario_names
from sim_pkg.scenario_files import SCENARIOS_DIR

GOOD = (SCENARIOS_DIR / "buttons.yaml").read_text()
STARTS = "  - [2, 1]\n  - [7, 8]\n"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("episode_limit:", "episode_limt:", r"bad.yaml:8: .*'episode_limt'.*mean 'episode_limit'"),
        ("  radius_m:", "  radios_m:", r"'robot.radios_m' \(did you mean 'radius_m'\?\)"),
        ("dt_s: 1.0", "dt_s: .nan", r"bad.yaml:7: dt_s = nan: .*finite"),
        ("dt_s: 1.0", "dt_s: .inf", r"dt_s = inf: .*finite"),
        ("dt_s: 1.0", "dt_s: -1.0", r"dt_s = -1.0: .*greater than 0"),
        ("dt_s: 1.0", "dt_s: fast", r"dt_s = 'fast': .*number"),
        ("dt_s: 1.0", "dt_s: 1.0\ndt_s: 2.0", r"bad.yaml:8: key 'dt_s' again, first in line 7"),
        ("rows: 10\n", "", r"key 'rows' is missing"),
        ("- [2, 1]", "- [2, 10]", r"cell \[2, 10\] is outside the grid; rows are 0..9"),
        ("- [2, 1]", "- [-1, 1]", r"bad.yaml:10: starts.0.0 = -1: .*greater than or equal to 0"),
        ("- [2, 1]", "- [2, 4]", r"cell \[2, 4\] is a button"),
        (STARTS, " []\n", r"starts = \[\]: .*at least 1"),
        ("- [7, 5]", "- [2, 4]", r"two buttons in the same cell"),
        ("radius_m: 0.4", "radius_m: 0.6", r"radius_m: 0.6 does not fit a cell; at most 0.5"),
        ("max_speed_mps: 1.5", "max_speed_mps: 1.0", r"max_speed_mps: 1.0 is too slow"),
        ("substeps: 8", "substeps: 1", r"physics.substeps = 1: .*greater than or equal to 4"),
        ("kind: buttons", "kind: button", r"kind = 'button' \(did you mean 'buttons'\?\)"),
        ("kind: buttons", "", r"kind = None; one of: buttons"),
        ("kind: buttons", "kind: [buttons]", r"kind = \['buttons'\].*; one of: buttons"),
        ("dt_s: 1.0", "dt_s: 1.0\n\a", r"bad.yaml:8: not valid YAML: control character"),
        (STARTS, " &x [*x]\n", r"an alias contains itself"),
        (STARTS, " [*mine]\n", r"bad.yaml:10: not valid YAML: .*alias in '\[\*mine\]'"),
        ("rows: 10", "rows: [10", r"bad.yaml:\d+: not valid YAML: while parsing a flow sequence"),
    ],
)
def test_bad_scenarios(tmp_path: Path, old: str, new: str, message: str) -> None:
    check_refused(tmp_path, GOOD, old, new, message)


def test_unknown_scenario_names_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown scenario 'butons'.*'buttons'.*buttons_8"):
        make_env("butons", 1)
    with pytest.raises(ConfigError, match="no scenario file"):
        make_env(tmp_path / "none.yaml", 1)


def test_every_shipped_scenario_loads() -> None:
    assert {"buttons", "buttons_8", "buttons_16"} <= set(scenario_names())
    for name in scenario_names():
        assert make_env(name, 1).spec.scenario == name


def test_a_path_works_like_a_name(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(GOOD)
    assert make_env(path, 1).spec.robots == make_env("buttons", 1).spec.robots


class Inner(StrictModel):
    depth: int = 1


class Outer(StrictModel):
    rate: float
    items: tuple[Inner, ...] = ()
    maybe: Inner | None = None
    on: bool = False
    table: dict[str, float] = Field(default_factory=dict)
    either: int | str = 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("rate: 1\nitems:\n  - depht: 2\n", "file.yaml:3: .*'items.0.depht'.*'depth'"),
        ("rate: 1\nmaybe: {deep: 2}\n", "'maybe.deep'.*known keys: depth"),
        ("- 1\n", "expected a mapping"),
        ("", "expected a mapping"),
        ("rate: 1\nitems: 3\nwrong: 2\n", r"\(and 1 more\)"),
        ("rate: true\n", "file.yaml:1: rate = True: a number is needed, not true or false"),
        ("rate: '1'\n", "file.yaml:1: rate = '1': a number is needed, not text"),
        (
            "rate: 1\nitems:\n  - depth: 2\n  - depth: yes\n",
            ":4: items.1.depth = True: a number",
        ),
        ("rate: 1\nmaybe: {depth: '3'}\n", "maybe.depth = '3': a number is"),
        ("rate: 1\ntable:\n  a: 1\n  b: '2'\n", "yaml:4: table.b = '2': a number"),
        ("rate: 1\n'on': 1\n", "file.yaml:2: on = 1: true or false is needed, not a number"),
        ("rate: 1\n'on': 'yes'\n", "file.yaml:2: on = 'yes': true or false is needed"),
    ],
)
def test_strict_loading(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_yaml_strict(path, Outer)


def test_what_is_a_number_is_read_as_one(tmp_path: Path) -> None:
    """Integers where a float is meant, whole floats where an integer is; text where it may be."""
    path = tmp_path / "file.yaml"
    path.write_text("rate: 2\nitems: [{depth: 1e3}]\ntable: {a: 3}\neither: '1'\n'on': yes\n")
    read = load_yaml_strict(path, Outer)
    assert (read.rate, read.items[0].depth, read.table, read.either, read.on) == (
        2.0, 1000, {"a": 3.0}, "1", True,
    )  # fmt: skip


def test_numbers_without_a_point_are_numbers(tmp_path: Path) -> None:
    path = tmp_path / "file.yaml"
    path.write_text("rate: 1e-3\n")
    assert load_yaml_strict(path, Outer).rate == 1e-3


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.yaml: cannot be read: No such file"):
        load_yaml_strict(tmp_path / "none.yaml", Outer)
