"""Small skirmish maps for tests, and a fight without physics, tick by tick."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from crash_coach_common.contract import IntArray
from crash_coach_common.strict_yaml import load_yaml_strict
from sim_pkg.env import Env
from sim_pkg.scenario_files import SCENARIOS_DIR, find_scenario
from sim_pkg.scenarios.skirmish import combat, orders
from sim_pkg.scenarios.skirmish.config import TICK_S, SkirmishConfig, shipped_units
from sim_pkg.scenarios.skirmish.tables import ATTACK, NEXT_HIT, ORDER, TARGET, Fight, Tables

Placed = tuple[str, float, float]


def write_map(folder: Path, robots: list[Placed], opponents: list[Placed], **changes: Any) -> Path:
    """A map in the open without jitter; ``changes`` replace its keys.

    ``dummy`` is a unit type that neither walks nor strikes: 50 shield, 100 health, armour 1.
    """
    values = yaml.safe_load((SCENARIOS_DIR / "skirmish" / "3s_vs_5z.yaml").read_text())
    for team, units in (("robots", robots), ("opponents", opponents)):
        values[team] = [{"unit": unit, "start_m": [x, y]} for unit, x, y in units]
    dummy = shipped_units()["zealot"].model_dump(mode="json")
    dummy |= {"speed_mps": 1e-6, "reach_m": 1e-6}
    values["jitter_m"] = 0.0
    values["unit_types"] = {"dummy": dummy} | changes.pop("unit_types", {})
    path = folder / "map.yaml"
    path.write_text(yaml.safe_dump(values | changes))
    return path


def load_map(scenario: str | Path) -> SkirmishConfig:
    return load_yaml_strict(find_scenario(scenario), SkirmishConfig)


def random_actions(env: Env, rng: np.random.Generator) -> IntArray:
    """(B, n) of each robot's available actions one at random."""
    scores = rng.random(env.available.shape) * env.available
    actions: IntArray = scores.argmax(axis=-1).astype(np.int32)
    return actions


class Duel:
    """One arena of compiled rules; units stand where they are put."""

    def __init__(self, config: SkirmishConfig) -> None:
        self.tables = Tables.of(config)
        self.n = len(config.robots)
        self.fight = Fight.allocate(self.tables, 1)
        starts_m = self.fight.begin(self.tables, 0, np.random.default_rng(0))
        self.bodies = np.zeros((1, len(starts_m), 4))
        self.bodies[0, :, :2] = starts_m
        self.running = np.ones(1, dtype=np.bool_)
        self.habits = (config.behaviour.help_m, config.behaviour.patience_s)
        self.phase_s = config.dt_s / 2

    def attack(self, unit: int, target: int) -> None:
        self.fight.whole[0, unit, ORDER] = ATTACK
        self.fight.whole[0, unit, TARGET] = target

    def tick(self) -> np.ndarray:
        """(d, d) damage of one tick."""
        d = self.bodies.shape[1]
        hits = np.zeros((1, d, d), dtype=np.float32)
        t, f = self.tables, self.fight
        combat.fight(
            self.running, 1, TICK_S, self.bodies, t.units, t.hits_s, t.damage, t.reach_m,
            f.extras_s, f.clock_s, f.real, f.whole, hits,
        )  # fmt: skip
        return hits[0]

    def plan(self) -> np.ndarray:
        """(d, 2) the velocities that a phase begins with."""
        t, f = self.tables, self.fight
        commands = np.zeros((1, self.bodies.shape[1], 2))
        orders.drive(
            self.running, self.n, self.phase_s, self.bodies, t.units, t.reach_m, t.acquire_m,
            t.leash_m, self.habits, t.goal_m, f.real, f.whole, commands,
        )  # fmt: skip
        return commands[0]

    def order(self, actions: list[int]) -> None:
        orders.take_orders(
            self.running, np.array([actions], dtype=np.int32), self.bodies, self.fight.real,
            self.fight.whole,
        )  # fmt: skip

    def targets(self) -> list[int]:
        """Of the opponents."""
        targets: list[int] = self.fight.whole[0, self.n :, TARGET].tolist()
        return targets

    def winding_up(self, unit: int) -> bool:
        return bool(self.fight.whole[0, unit, NEXT_HIT] == 0)
