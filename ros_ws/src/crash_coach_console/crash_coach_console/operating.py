"""What an operator's clicks mean for the coach's parameters, of which there is one set for all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.config import CoachConfig
from crash_coach_pkg.coach.parameters import NOBODY, Value, parameter_specs

AT_START = ("robots", "roles", "dt_s", "fault_scenario", "follow_sim")
WATCHED = (*AT_START, *(spec.name for spec in parameter_specs()))
"""Every parameter of the coach that the console reads."""


class OperatorError(UserError):
    """The coach did not do what was asked; the text is the reason."""


def named_victims(settings: Mapping[str, Value]) -> tuple[str, ...]:
    """Whom the parameter ``victims`` crashes now."""
    victims = settings.get("victims", ())
    if not settings.get("enabled", False) or not isinstance(victims, tuple):
        return ()
    return tuple(str(name) for name in victims if name != NOBODY)


def with_others(wanted: Mapping[str, Value], settings: Mapping[str, Value]) -> dict[str, Value]:
    """``wanted``, with the robots that crash in the very same way already.

    One set of parameters holds for all victims: others, that crash in another way, are replaced.
    """
    before = named_victims(settings)
    how = {name: value for name, value in wanted.items() if name not in ("victims", "apply_at")}
    chosen = wanted["victims"]
    assert isinstance(chosen, Sequence)
    if not before or any(settings.get(name) != value for name, value in how.items()):
        return dict(wanted)
    more = [str(name) for name in chosen if name not in before]
    return {**wanted, "victims": (*before, *more)}


def joined(before: CoachConfig, wanted: CoachConfig) -> CoachConfig:
    """``with_others`` for a coach without parameters."""
    changing = {"victims": (), "start_step": 0}
    alike = before.model_copy(update=changing) == wanted.model_copy(update=changing)
    if not alike:
        return wanted
    more = (name for name in wanted.victims if name not in before.victims)
    return wanted.model_copy(update={"victims": (*before.victims, *more)})


def victims_left(robots: Sequence[str], settings: Mapping[str, Value]) -> tuple[str, ...]:
    """Who goes on crashing when the faults of ``robots`` end; none named: nobody.

    Raises:
        OperatorError: a robot that no parameter names: the coach drew it, or it is not crashed.
    """
    victims = named_victims(settings)
    for name in robots:
        if name not in victims:
            known = ", ".join(victims) or "nobody"
            raise OperatorError(
                f"{name} is not among the coach's victims ({known}): a robot that the coach drew "
                "is cleared with all others"
            )
    return tuple(name for name in victims if name not in robots) if robots else ()


def settings_value(settings: Mapping[str, Value]) -> dict[str, Any]:
    """JSON values: what an operator should see of the coach, others' modes' parameters left out."""
    mode = settings.get("crash_mode", "")
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in settings.items()
        if "." not in name or name.startswith(f"{mode}.")
    }
