"""Whom faults can concern."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from crash_coach_common.contract import EnvSpec, UserError


@dataclass(frozen=True)
class TeamSpec:
    """Whom faults can concern.

    ``roles``: one for each robot, or empty where nobody has one. ``dt_s``: length of a control
    step; None: unknown.

    Raises:
        UserError: names that are not distinct ROS names, a wrong number of roles, or dt_s <= 0.
    """

    robots: tuple[str, ...]
    roles: tuple[str, ...] = ()
    dt_s: float | None = None

    def __post_init__(self) -> None:
        check_robots(self.robots)
        if self.roles and len(self.roles) != len(self.robots):
            raise UserError(
                f"roles {list(self.roles)}: {len(self.roles)} for {len(self.robots)} robots; "
                "one for each robot is needed, or none at all"
            )
        if self.dt_s is not None and not 0 < self.dt_s < float("inf"):
            raise UserError(f"dt_s {self.dt_s}: the length of a control step is positive")

    @classmethod
    def of(cls, spec: EnvSpec) -> TeamSpec:
        """The team that plays a scenario."""
        return cls(spec.robots, spec.roles, spec.dt_s)

    @property
    def n(self) -> int:
        return len(self.robots)

    def of_role(self, role: str) -> tuple[int, ...]:
        """Indexes of the robots of ``role``; '': of all."""
        return tuple(i for i in range(self.n) if not role or self.roles[i : i + 1] == (role,))


def check_robots(names: Sequence[str]) -> tuple[str, ...]:
    """A team's names. Raises UserError unless they are distinct and fit for topic names."""
    if not names:
        raise UserError("robots is empty; name at least one robot")
    for name in names:
        if not re.fullmatch(r"[A-Za-z_][A-Za-z0-9_]*", name):
            raise UserError(f"robot name {name!r} is not a valid ROS name (letters, digits, _)")
        if list(names).count(name) > 1:
            raise UserError(f"robots names {name!r} more than once")
    return tuple(names)
