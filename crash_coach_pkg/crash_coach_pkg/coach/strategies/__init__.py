"""The strategies by name: built in, registered, or installed by another package."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from crash_coach_common.contract import UserError
from crash_coach_common.plugins import with_installed
from crash_coach_common.wrong_key import Misplaced, did_you_mean
from crash_coach_pkg.coach.strategies.adaptive import Adaptive
from crash_coach_pkg.coach.strategies.base import Candidates, Strategy, StrategySettings
from crash_coach_pkg.coach.strategies.curriculum import Curriculum
from crash_coach_pkg.coach.strategies.deck import Deck
from crash_coach_pkg.coach.strategies.failure import Failure
from crash_coach_pkg.coach.strategies.fixed import Fixed
from crash_coach_pkg.coach.strategies.learnability import Learnability
from crash_coach_pkg.coach.strategies.nobody import Nobody
from crash_coach_pkg.coach.strategies.patient import Patient
from crash_coach_pkg.faults import SYNONYMS, mode_names
from crash_coach_pkg.faults.schema import ParameterInfo, number_fields

ENTRY_POINT_GROUP = "crash_coach.strategies"
AnyStrategy = Strategy[Any]

_BUILT_IN: tuple[type[AnyStrategy], ...] = (
    Nobody, Fixed, Curriculum, Adaptive, Patient, Deck, Learnability, Failure,
)  # fmt: skip
_strategies: dict[str, type[AnyStrategy]] = {strategy.name: strategy for strategy in _BUILT_IN}
_installed_read = False


def register(strategy: type[AnyStrategy]) -> None:
    """Makes a strategy known to this process.

    Raises:
        ValueError: it is none, its name is taken or not allowed, or a setting lacks default,
            range, unit or description.
    """
    _check(strategy, _known())
    _strategies[strategy.name] = strategy


def _check(strategy: type[AnyStrategy], known: Mapping[str, type[AnyStrategy]]) -> None:
    if not (isinstance(strategy, type) and issubclass(strategy, Strategy)):
        raise ValueError(f"{strategy!r} is not a Strategy")
    name = getattr(strategy, "name", "")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", name):
        raise ValueError(f"strategy {name!r}: a name has lower-case letters, digits and _")
    if name in known:
        raise ValueError(f"strategy {name!r}: the name is taken by {known[name]!r}")
    if name in (*mode_names(), *SYNONYMS):
        raise ValueError(f"strategy {name!r}: the name is taken by a fault mode")
    settings_of(strategy)


def _known() -> dict[str, type[AnyStrategy]]:
    global _installed_read
    if not _installed_read:
        _strategies.update(with_installed(ENTRY_POINT_GROUP, _strategies, _check))
        _installed_read = True
    return _strategies


def strategy_names() -> tuple[str, ...]:
    """Built-in, registered and installed strategies, in this order."""
    return tuple(_known())


def is_strategy(name: object) -> bool:
    """Installed ones are looked for only where it is no other's name."""
    return name in _strategies or name in _known()


def find_strategy(name: str) -> type[AnyStrategy]:
    """The strategy of that name. Raises UserError naming the known ones."""
    if is_strategy(name):
        return _strategies[name]
    hint = did_you_mean(name, strategy_names())
    raise UserError(
        f"unknown coaching strategy {name!r}{hint}; one of: {', '.join(strategy_names())}"
    )


def settings_of(strategy: type[AnyStrategy]) -> tuple[ParameterInfo, ...]:
    """In the order of the schema.

    Raises:
        ValueError: a setting that is not a number, or lacks default, range, unit or description.
    """
    return number_fields(f"strategy {strategy.name!r}: setting", strategy.Settings)


def check_settings(name: str, values: Mapping[str, Any]) -> StrategySettings:
    """The settings of strategy ``name``.

    Raises:
        UserError: an unknown strategy.
        Misplaced: names strategy, setting, value and what would be right.
    """
    schema = find_strategy(name).Settings
    for key, value in values.items():  # of which pydantic would make a number
        if key in schema.model_fields and isinstance(value, bool | str):
            text = f"strategy {name}: setting {key} = {value!r}: a number is needed"
            raise Misplaced((name, key), text)
    try:
        return schema.model_validate(values)
    except ValidationError as error:
        detail = error.errors()[0]
        known = ", ".join(schema.model_fields) or "none"
        where = ".".join(str(part) for part in detail["loc"])
        if detail["type"] == "extra_forbidden":
            text = f"unknown setting {where!r}{did_you_mean(where, schema.model_fields)}"
        elif where:
            text = f"setting {where} = {detail['input']!r}: {detail['msg']}"
        else:
            text = str(detail["msg"]).removeprefix("Value error, ")
        text = f"strategy {name}: {text} (its settings: {known})"
        raise Misplaced((name, *detail["loc"]), text) from None


def make_strategy(name: str, settings: StrategySettings, candidates: Candidates) -> AnyStrategy:
    """Of checked settings. Raises UserError where the name is not known."""
    return find_strategy(name)(settings, candidates)
