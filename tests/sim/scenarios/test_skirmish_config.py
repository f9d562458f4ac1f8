"""What is refused when a map is loaded, and where the message points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from bad_files import check_refused

from crash_coach_common.strict_yaml import ConfigError
from sim_pkg.env import make_env
from sim_pkg.scenario_files import SCENARIOS_DIR, scenario_names
from sim_pkg.scenarios.skirmish.config import shipped_units

GOOD = (SCENARIOS_DIR / "skirmish" / "3m.yaml").read_text()
LINES = GOOD.splitlines()
FIRST = next(line for line in LINES if "unit:" in line)
AT = LINES.index(FIRST) + 1
OTHER = next(line for line in LINES[AT:] if "unit:" in line)
THEIRS = next(line for line in LINES[LINES.index("opponents:") :] if "unit:" in line)
TEAM = "\n".join(LINES[AT - 1 : LINES.index("opponents:")]) + "\n"


def placed(x: float, y: float, unit: str = "marine") -> str:
    return f"  - {{unit: {unit}, start_m: [{x}, {y}]}}"


OUTSIDE = r"start_m = \[9, 7.3\]: outside the walls, .* cannot reach it; .* y in 7.625..23.375"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (FIRST, placed(9, 20, "marin"), rf":{AT}: robots.0.unit = 'marin': unknown unit type "),
        (FIRST, placed(9, 20, "marin"), r"did you mean 'marine'.*known: marine, stalker, zealot"),
        (FIRST, FIRST.replace("unit:", "unti:"), rf":{AT}: unknown key 'robots.0.unti'.*'unit'"),
        (TEAM, "  []\n", r"robots = \[\]: .*at least 1"),
        (FIRST, OTHER, rf":{AT + 1}: robots.1.start_m = .*: can overlap robots.0, 0 m away"),
        (FIRST, THEIRS, r"opponents.0.start_m = .*: can overlap robots.0, .* at least 1.45711"),
        (FIRST, placed(9, 7.3), rf":{AT}: robots.0.{OUTSIDE}"),
        (THEIRS, placed(9, 7.3), rf"opponents.0.{OUTSIDE}"),
        ("free_m: [0.0, 7.0, 32.0, 24.0]", "free_m: [0, 24, 32, 7]", "no rectangle"),
        ("free_m: [0.0, 7.0, 32.0, 24.0]", "free_m: [0, 7, 33, 24]", r"bad.yaml:6: .*32 x 32 m"),
        ("dt_s: 0.5", "dt_s: 0.3", r"bad.yaml:3: dt_s = 0.3: must be a multiple of 0.125"),
        ("substeps: 4", "substeps: 5", r"substeps = 5: .*multiple of 2"),
        ("substeps: 4", "substeps: 2", r"substeps = 2: .*greater than or equal to 4"),
        ("patience_s: 4.0", "patients_s: 4.0", r"'behaviour.patients_s'.*mean 'patience_s'"),
        ("jitter_m: 0.25", "jitter_m: -1", r"jitter_m = -1: .*greater than or equal to 0"),
        ("jitter_m: 0.25", "jitter_m: .nan", r"jitter_m = nan: .*finite"),
    ],
)
def test_bad_maps(tmp_path: Path, old: str, new: str, message: str) -> None:
    check_refused(tmp_path, GOOD, old, new, message)


def with_unit(tmp_path: Path, name: str, **changes: object) -> Path:
    """3m with a unit type of its own, used by the first robot."""
    unit = shipped_units()["zealot"].model_dump(mode="json") | changes
    values = yaml.safe_load(GOOD) | {"unit_types": {name: unit}}
    values["robots"][0]["unit"] = name
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def test_a_user_adds_a_unit_type_in_yaml_alone(tmp_path: Path) -> None:
    env = make_env(with_unit(tmp_path, "ogre", health=300.0, radius_m=0.6), 2)
    # Mixed now, with a shield in the robots' team: two type bits, one shield each.
    assert env.spec.obs_size == 4 + 3 * 7 + 2 * 8 + 4
    env.reset(np.arange(2), 0, np.arange(2))
    env.step(np.full((2, 3), 4, dtype=np.int32))
    assert env.scene.radii_m == (0.6, 0.375, 0.375)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hits_s": [0.3, 0.0]}, r"ogre.hits_s = \[0.3, 0.0\]: .*in order of time"),
        ({"hits_s": [1.2]}, r"ogre.hits_s = \[1.2\]: .*within the cooldown, at most at 1.075"),
        ({"hits_s": []}, r"ogre.hits_s = \[\]: .*at least 1"),
        ({"cooldown_s": 0.1}, r"ogre.cooldown_s = 0.1: .*greater than or equal to 0.25"),
        ({"body_radius_m": 0.6}, r"ogre.body_radius_m = 0.6: at most radius_m, 0.5"),
        ({"radius_m": 9, "body_radius_m": 4}, r"ogre.body_radius_m = 4: .*less than or equal to 3"),
        ({"health": 1e300}, r"ogre.health = 1e\+300: .*less than or equal to"),
        ({"health": 0}, r"ogre.health = 0: .*greater than 0"),
        ({"friction": 1.5}, r"ogre.friction = 1.5: .*less than or equal to 1"),
        ({"colour": "red"}, r"unknown key 'unit_types.ogre.colour'"),
    ],
)
def test_bad_unit_types(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = with_unit(tmp_path, "ogre", **changes)
    with pytest.raises(ConfigError, match=message) as error:
        make_env(path, 1)
    assert "mine.yaml:" in str(error.value)


def test_a_shipped_unit_type_is_not_redefined(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unit_types.stalker: units.yaml has that name"):
        make_env(with_unit(tmp_path, "stalker"), 1)


def test_the_maps_are_there() -> None:
    names = {"3m", "8m", "2s3z", "3s_vs_3z", "3s_vs_5z", "3s5z_vs_3s5z", "8m_vs_5z", "8s_vs_3s5z"}
    assert {f"skirmish/{name}" for name in names} <= set(scenario_names())
    sizes = {
        name: (spec.obs_size, spec.state_size, spec.episode_limit)
        for name in names
        for spec in (make_env(f"skirmish/{name}", 1).spec,)
    }
    assert sizes["3s_vs_5z"] == (48, 68, 250)
    assert sizes["3s5z_vs_3s5z"] == (128, 216, 150)
    assert sizes["8m_vs_5z"] == (70, 140, 120)
    assert sizes["8s_vs_3s5z"] == (128, 216, 150)
    assert make_env("skirmish/3m", 1).spec.stay_actions == (1, 0)
