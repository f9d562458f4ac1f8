"""What `ros2 param dump`, `load` and `describe` do, through the services that they call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from coach_graph import ROBOTS, Graph, graph
from coach_operator import Operator

READ_ONLY = ("robots", "roles", "dt_s", "fault_scenario", "follow_sim")


def dump(setter: Operator) -> dict[str, Any]:
    """Every parameter of the coach."""
    names = sorted(setter.names())
    values = [list(v) if hasattr(v, "typecode") else v for v in setter.get(*names)]
    return dict(zip(names, values, strict=True))


def load(setter: Operator, path: Path, parameters: dict[str, Any]) -> dict[str, tuple[bool, str]]:
    """As `ros2 param load`: {name: (successful, reason)}."""
    path.write_text(yaml.safe_dump({"/coach": {"ros__parameters": parameters}}, sort_keys=False))
    results = setter.load(str(path))
    return {name: (r.successful, r.reason) for name, r in zip(parameters, results, strict=True)}


def test_what_was_dumped_can_be_loaded_in_any_order(
    ros_env: dict[str, str], tmp_path: Path
) -> None:
    with graph(ros_env, dt_s=0.1) as g:
        fresh = dump(g.operator)
        changed = {
            "victims": [ROBOTS[1]], "crash_mode": "delay", "delay.steps": 7, "min_alive": 1,
            "strategy": "adaptive", "adaptive.beta": 0.5,
        }  # fmt: skip
        assert not g.operator.set(**changed)
        assert g.operator.clear().success  # victims, and enabled is false
        kept = dump(g.operator)
        for parameters in (fresh, kept, dict(reversed(kept.items())), fresh):
            told = load(g.operator, tmp_path / "coach.yaml", parameters)
            left = {name: why for name, (done, why) in told.items() if not done}
            assert set(left) >= set(READ_ONLY)
            assert all("read-only" in why for why in left.values()), left
            assert dump(g.operator) == parameters
        alone(g, tmp_path)


def alone(g: Graph, folder: Path) -> None:
    """What cannot be loaded has a reason of its own, and the rest is loaded all the same."""
    parameters = {"dt_s": 0.2, "adaptive.beta": 0.25, "crash_rate": 7.0, "adaptive.rho": 0.5}
    told = load(g.operator, folder / "wrong.yaml", parameters)
    assert {name: done for name, (done, _) in told.items()} == {
        "dt_s": False, "adaptive.beta": True, "crash_rate": False, "adaptive.rho": True,
    }  # fmt: skip
    assert "read-only" in told["dt_s"][1]
    assert g.operator.get("adaptive.beta", "adaptive.rho") == [0.25, 0.5]


def test_enumerated_parameters_are_described_with_their_choices(ros_env: dict[str, str]) -> None:
    names = ("apply_at", "crash_mode", "strategy", "cap_rule", "success_from")
    with graph(ros_env) as g:
        told = {d.name: d.additional_constraints for d in g.operator.describe(names)}
    assert told["apply_at"] == "one of: next_episode, next_step"
    assert "mute, random" in told["crash_mode"]
    assert all(text.startswith("one of: ") for text in told.values())
