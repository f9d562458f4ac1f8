"""The fault modes by name: built in, registered, or installed by another package."""

from __future__ import annotations

import re
from collections.abc import Mapping

from pydantic import ValidationError

from crash_coach_common.contract import UserError
from crash_coach_common.plugins import with_installed
from crash_coach_common.wrong_key import did_you_mean
from crash_coach_pkg.faults.adversarial import Adversarial
from crash_coach_pkg.faults.base import (
    CommandFault,
    FaultMode,
    FaultParameters,
    Need,
    ObservationFault,
)
from crash_coach_pkg.faults.bias import Bias
from crash_coach_pkg.faults.blind import Blind
from crash_coach_pkg.faults.delay import Delay
from crash_coach_pkg.faults.drop import Drop
from crash_coach_pkg.faults.freeze import Freeze
from crash_coach_pkg.faults.mute import Mute
from crash_coach_pkg.faults.noise import Noise
from crash_coach_pkg.faults.random import Random
from crash_coach_pkg.faults.scale import Scale
from crash_coach_pkg.faults.schema import parameters_of
from crash_coach_pkg.faults.stale import Stale

ENTRY_POINT_GROUP = "crash_coach.faults"
SYNONYMS = {"stay": "mute"}
"""``stay`` is the paper's word for ``mute``."""

_BUILT_IN: tuple[type[FaultMode], ...] = (
    Mute, Random, Freeze, Delay, Drop, Bias, Scale, Adversarial, Blind, Stale, Noise,
)  # fmt: skip
_OWN_CODES = range(128, 256)
_NEEDED = {
    "availability": "which commands the robot can execute",
    "sampler": "a way to draw random commands",
    "worst": "the command that the policy values least",
    "vector": "velocities (a Twist type)",
}

_modes: dict[str, type[FaultMode]] = {mode.name: mode for mode in _BUILT_IN}
_installed_read = False


def register(mode: type[FaultMode]) -> None:
    """Makes a mode known to this process.

    Raises:
        ValueError: its name or code is taken or not allowed, a parameter without range, unit or
            description, or neither a command nor an observation fault.
    """
    _check(mode, _known_modes())
    _modes[mode.name] = mode


def _check(mode: type[FaultMode], known: Mapping[str, type[FaultMode]]) -> None:
    if not (isinstance(mode, type) and issubclass(mode, CommandFault | ObservationFault)):
        raise ValueError(f"{mode!r} is neither a CommandFault nor an ObservationFault")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", mode.name):
        raise ValueError(f"fault mode {mode.name!r}: a name has lower-case letters, digits and _")
    if mode.code not in _OWN_CODES:
        raise ValueError(
            f"fault mode {mode.name!r}: code {mode.code} is not in "
            f"{_OWN_CODES.start}..{_OWN_CODES.stop - 1}"
        )
    for other in known.values():
        if mode.name in (other.name, *SYNONYMS) or mode.code == other.code:
            raise ValueError(
                f"fault mode {mode.name!r} (code {mode.code}): name or code is taken by "
                f"{other.name!r} (code {other.code})"
            )
    parameters_of(mode)


def _known_modes() -> dict[str, type[FaultMode]]:
    global _installed_read
    if not _installed_read:
        _modes.update(with_installed(ENTRY_POINT_GROUP, _modes, _check))
        _installed_read = True
    return _modes


def mode_names() -> tuple[str, ...]:
    """Every known mode, in order of their codes."""
    return tuple(mode.name for mode in sorted(_known_modes().values(), key=lambda m: m.code))


def fault_mode(name: str) -> type[FaultMode]:
    """The mode of that name (or synonym). Raises UserError naming the known ones."""
    modes = _known_modes()
    try:
        return modes[SYNONYMS.get(name, name)]
    except KeyError:
        known = ", ".join((*mode_names(), *SYNONYMS))
        raise UserError(f"unknown crash mode {name!r}; one of: {known}") from None


def mode_code(name: str) -> int:
    """0 for the empty name: no fault."""
    return fault_mode(name).code if name else 0


def unmet_needs(mode: str, offered: frozenset[Need]) -> str | None:
    """Why ``mode`` cannot act on commands that offer no more than this; None: it can.

    Raises:
        UserError: an unknown mode.
    """
    missing = [_NEEDED[need] for need in sorted(fault_mode(mode).needs - offered)]
    if not missing:
        return None
    return f"crash mode {mode} needs {' and '.join(missing)}, which these commands do not offer"


def is_observation_mode(mode: str) -> bool:
    """Whether it changes what policies see. Raises UserError for an unknown mode."""
    return issubclass(fault_mode(mode), ObservationFault)


def check_parameters(mode: str, parameters: Mapping[str, float]) -> FaultParameters:
    """Raises UserError naming mode, parameter, value and what would be right."""
    schema = fault_mode(mode).Parameters
    try:
        return schema(**parameters)
    except ValidationError as error:
        detail = error.errors()[0]
        name = ".".join(str(part) for part in detail["loc"])
        known = ", ".join(schema.model_fields) or "none"
        if detail["type"] == "extra_forbidden":
            hint = did_you_mean(name, schema.model_fields)
            raise UserError(
                f"crash mode {mode}: no parameter {name!r}{hint} (its parameters: {known})"
            ) from None
        raise UserError(
            f"crash mode {mode}: parameter {name} = {detail['input']!r}: {detail['msg']} "
            f"(its parameters: {known})"
        ) from None


def make_fault(
    mode: str, parameters: Mapping[str, float]
) -> CommandFault[object] | ObservationFault:
    """A fault at the start of its stretch. Raises UserError as ``check_parameters``."""
    made = fault_mode(mode)(check_parameters(mode, parameters))
    if not isinstance(made, CommandFault | ObservationFault):
        raise TypeError(f"fault mode {mode!r} was registered without a check")
    return made
