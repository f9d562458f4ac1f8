"""The fault modes by name: built in, registered, or installed by another package."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points

from pydantic import ValidationError

from crash_coach_pkg.faults.base import CommandFault, FaultMode, FaultParameters, ObservationFault
from crash_coach_pkg.faults.freeze import Freeze
from crash_coach_pkg.faults.mute import Mute
from crash_coach_pkg.faults.random import Random
from sim_pkg.contract import UserError

ENTRY_POINT_GROUP = "crash_coach.faults"
SYNONYMS = {"stay": "mute"}
"""``stay`` is the paper's word for ``mute``."""

_MODES: dict[str, type[FaultMode]] = {mode.name: mode for mode in (Mute, Random, Freeze)}
_installed_read = False


def register(mode: type[FaultMode]) -> None:
    """Makes a mode known to this process.

    Raises:
        ValueError: its name or code is taken, or neither command nor observation fault.
    """
    if not issubclass(mode, CommandFault | ObservationFault):
        raise ValueError(f"{mode.__name__} is neither a CommandFault nor an ObservationFault")
    if not 1 <= mode.code <= 255:
        raise ValueError(f"fault mode {mode.name!r}: code {mode.code} is not in 1..255")
    for other in _MODES.values():
        if mode.name in (other.name, *SYNONYMS) or mode.code == other.code:
            raise ValueError(
                f"fault mode {mode.name!r} (code {mode.code}): name or code is taken by "
                f"{other.name!r} (code {other.code})"
            )
    _MODES[mode.name] = mode


def _modes() -> dict[str, type[FaultMode]]:
    global _installed_read
    if not _installed_read:
        _installed_read = True
        for point in entry_points(group=ENTRY_POINT_GROUP):
            register(point.load())
    return _MODES


def mode_names() -> tuple[str, ...]:
    """Every known mode, in order of their codes."""
    return tuple(mode.name for mode in sorted(_modes().values(), key=lambda m: m.code))


def fault_mode(name: str) -> type[FaultMode]:
    """The mode of that name (or synonym). Raises UserError naming the known ones."""
    modes = _modes()
    try:
        return modes[SYNONYMS.get(name, name)]
    except KeyError:
        known = ", ".join((*mode_names(), *SYNONYMS))
        raise UserError(f"unknown crash mode {name!r}; one of: {known}") from None


def mode_code(name: str) -> int:
    """0 for the empty name: no fault."""
    return fault_mode(name).code if name else 0


def check_parameters(mode: str, parameters: Mapping[str, float]) -> FaultParameters:
    """Raises UserError naming mode, parameter, value and what would be right."""
    schema = fault_mode(mode).Parameters
    try:
        return schema(**parameters)
    except ValidationError as error:
        detail = error.errors()[0]
        name = ".".join(str(part) for part in detail["loc"])
        known = ", ".join(schema.model_fields) or "none"
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
