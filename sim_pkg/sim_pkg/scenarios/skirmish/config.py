"""What a skirmish map and a unit type may say, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, ValidationInfo, field_validator, model_validator

from crash_coach_common.strict_yaml import Misplaced, StrictModel, did_you_mean, load_yaml_strict
from sim_pkg.scenarios.base import EpisodeLimit, MassKg, PhysicsConfig, SpeedMps, StepSeconds
from sim_pkg.scenarios.skirmish.layout import ATTACK_M, Layout

UNITS_FILE = Path(__file__).parents[2] / "configs" / "units.yaml"

TICK_S = 1 / 16  # StarCraft II's game loop at its "Normal" speed
PHASES = 2  # how often in a control step velocities are commanded anew

# Far beyond any use; sums and squares of more would not be finite.
LARGEST = 1e9
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NotNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Point = tuple[float, float]


class UnitConfig(StrictModel):
    """A unit type; units.yaml says what each key means."""

    health: Positive
    shield: NotNegative
    shield_per_s: NotNegative
    shield_after_s: NotNegative
    armour: NotNegative
    armoured: bool
    radius_m: Positive
    # An attack on a body that one touches can be ordered.
    body_radius_m: float = Field(gt=0, le=ATTACK_M / 2)
    mass_kg: MassKg
    friction: float = Field(ge=0, le=1)
    speed_mps: SpeedMps
    damage: Positive
    damage_to_armoured: NotNegative
    reach_m: Positive
    cooldown_s: float = Field(ge=4 * TICK_S, le=LARGEST)
    hits_s: tuple[NotNegative, ...] = Field(min_length=1, max_length=8)

    @field_validator("body_radius_m")
    @classmethod
    def _within_reach(cls, body_radius_m: float, info: ValidationInfo) -> float:
        radius_m = info.data.get("radius_m", math.inf)
        if body_radius_m > radius_m:
            raise ValueError(
                f"at most radius_m, {radius_m:g}: reach is measured from that, and a larger body "
                "would keep attackers off"
            )
        return body_radius_m

    @field_validator("hits_s")
    @classmethod
    def _in_order(cls, hits_s: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        if list(hits_s) != sorted(hits_s):
            raise ValueError("an attack's hits must be in order of time")
        # An attack is over before the next one starts, whose cooldown may be a tick shorter.
        longest = info.data.get("cooldown_s", math.inf) - 2 * TICK_S
        if hits_s[-1] > longest:
            raise ValueError(f"the last hit must land within the cooldown, at most at {longest:g}")
        return hits_s


class UnitTypes(StrictModel):
    unit_types: dict[str, UnitConfig] = Field(min_length=1)


class PlacedUnit(StrictModel):
    unit: str
    start_m: Point


class BehaviourConfig(StrictModel):
    acquire_m: Positive
    help_m: NotNegative
    leash_m: Positive
    patience_s: NotNegative


class PhasesConfig(PhysicsConfig):
    substeps: int = Field(ge=4, le=1000, multiple_of=PHASES)


class SkirmishConfig(StrictModel):
    """A map; the shipped ones say what each key means.

    ``unit_types``: the map's own types, next to those of units.yaml. ``standard``: what a
    units.yaml beside the map says, as in the copy that a run keeps; null: the program's counts.
    """

    kind: Literal["skirmish"]
    dt_s: StepSeconds
    episode_limit: EpisodeLimit
    arena_m: tuple[Positive, Positive]
    free_m: tuple[NotNegative, NotNegative, Positive, Positive]
    robots: tuple[PlacedUnit, ...] = Field(min_length=1, max_length=64)
    opponents: tuple[PlacedUnit, ...] = Field(min_length=1, max_length=64)
    jitter_m: NotNegative
    behaviour: BehaviourConfig
    physics: PhasesConfig
    unit_types: dict[str, UnitConfig] = Field(default_factory=dict)
    standard: UnitTypes | None = Field(None, exclude_if=lambda units: units is None)

    @property
    def standard_types(self) -> dict[str, UnitConfig]:
        """The unit types that are no map's own."""
        return shipped_units() if self.standard is None else self.standard.unit_types

    @property
    def placed(self) -> tuple[PlacedUnit, ...]:
        """Robots, then opponents."""
        return self.robots + self.opponents

    @property
    def types(self) -> dict[str, UnitConfig]:
        """Every unit type that the map may use."""
        return self.standard_types | self.unit_types

    @property
    def units(self) -> tuple[UnitConfig, ...]:
        """The type of each placed unit."""
        types = self.types
        return tuple(types[placed.unit] for placed in self.placed)

    @property
    def layout(self) -> Layout:
        robots = [placed.unit for placed in self.robots]
        opponents = [placed.unit for placed in self.opponents]
        shielded = [name for name, unit in self.types.items() if unit.shield > 0]
        return Layout.of(robots, opponents, shielded)

    @field_validator("dt_s")
    @classmethod
    def _whole_phases(cls, dt_s: float) -> float:
        if not (dt_s / (PHASES * TICK_S)).is_integer():
            raise ValueError(f"must be a multiple of {PHASES * TICK_S}")
        return dt_s

    @model_validator(mode="after")
    def _check(self) -> SkirmishConfig:
        west, south, east, north = self.free_m
        if not (west < east <= self.arena_m[0] and south < north <= self.arena_m[1]):
            raise Misplaced(
                ("free_m",),
                f"free_m = {list(self.free_m)}: no rectangle x1, y1, x2, y2 in the arena, "
                f"which is {self.arena_m[0]:g} x {self.arena_m[1]:g} m",
            )
        types = self.standard_types
        for name in self.unit_types:
            if name in types:
                raise Misplaced(
                    ("unit_types", name), f"unit_types.{name}: {UNITS_FILE.name} has that name"
                )
        self._check_units()
        self._check_starts()
        return self

    def _places(self) -> Iterator[tuple[tuple[str, int], PlacedUnit]]:
        for team in ("robots", "opponents"):
            for index, placed in enumerate(getattr(self, team)):
                yield (team, index), placed

    def _check_units(self) -> None:
        types = self.types
        for (team, index), placed in self._places():
            if placed.unit not in types:
                raise Misplaced(
                    (team, index, "unit"),
                    f"{team}.{index}.unit = {placed.unit!r}: unknown unit type"
                    f"{did_you_mean(placed.unit, types)}; known: {', '.join(types)}",
                )

    def _check_starts(self) -> None:
        west, south, east, north = self.free_m
        jitter = self.jitter_m
        units, before = self.units, list[tuple[str, PlacedUnit, float]]()
        for ((team, index), placed), unit in zip(self._places(), units, strict=True):
            (x, y), radius = placed.start_m, unit.body_radius_m
            spare = radius + jitter
            name = f"{team}.{index}.start_m = [{x:g}, {y:g}]"
            inside_x = west + spare <= x <= east - spare
            if not (inside_x and south + spare <= y <= north - spare):
                raise Misplaced(
                    (team, index, "start_m"),
                    f"{name}: outside the walls, where the other team cannot reach it; x must be "
                    f"in {west + spare:g}..{east - spare:g}, "
                    f"y in {south + spare:g}..{north - spare:g} (with radius and jitter_m)",
                )
            for other_name, other, other_radius in before:
                gap = math.dist(placed.start_m, other.start_m)
                needed = radius + other_radius + 2 * math.sqrt(2) * jitter
                if gap < needed:
                    raise Misplaced(
                        (team, index, "start_m"),
                        f"{name}: can overlap {other_name}, {gap:g} m away; at least "
                        f"{needed:g} is needed (with radii and jitter_m)",
                    )
            before.append((f"{team}.{index}", placed, radius))


@cache
def shipped_units() -> dict[str, UnitConfig]:
    """The unit types of units.yaml.

    Raises:
        ConfigError: the file is wrong.
    """
    return load_yaml_strict(UNITS_FILE, UnitTypes).unit_types
