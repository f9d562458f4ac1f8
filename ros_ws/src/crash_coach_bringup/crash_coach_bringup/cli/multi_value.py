"""Options that take several values, up to the next option: --crashed 0 1 2."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args, get_type_hints

from crash_coach_bringup.cli.output import CliError

PAIRS = ("--set", "--param")  # their values are NAME=VALUE
Fits = Callable[[str], bool]


@dataclass(frozen=True)
class Syntax:
    """Of one verb. What does not fit an option any more is an argument again, so only a value of
    free text can be mistaken for one of an option.

    several: options with several values, and what these look like; free: those that take any text.
    single: options with exactly one value. argument: the name of the first, '' without any.
    """

    several: Mapping[str, Fits]
    free: frozenset[str]
    single: frozenset[str]
    argument: str


def expand(arguments: Sequence[str], command: Any) -> list[str]:
    """The command line with one value per option, as typer reads it.

    Args:
        command: of typer.main.get_command; it knows every verb's options.

    Raises:
        CliError: an option of free text took what was to be the verb's argument.
    """
    depth = 0
    while depth < len(arguments) and arguments[depth] in getattr(command, "commands", {}):
        command = command.commands[arguments[depth]]
        depth += 1
    if hasattr(command, "commands"):  # no verb, or an unknown one, as typer will say
        return list(arguments)
    return [*arguments[:depth], *_repeated(arguments[depth:], syntax_of(command))]


def syntax_of(command: Any) -> Syntax:
    """Of a verb's command."""
    options = [p for p in command.params if p.param_type_name == "option"]
    hints = get_type_hints(inspect.unwrap(command.callback))
    several = {p.opts[0]: _fits(p.opts[0], hints[p.name]) for p in options if p.multiple}
    names = [p.metavar or p.name.upper() for p in command.params if p.param_type_name == "argument"]
    return Syntax(
        several=several,
        free=frozenset(name for name, fits in several.items() if fits is _anything),
        single=frozenset(
            name for p in options if not p.is_flag and not p.multiple for name in p.opts
        ),
        argument=names[0] if names else "",
    )


def _fits(option: str, hint: Any) -> Fits:
    kinds = [kind for part in (hint, *get_args(hint)) for kind in get_args(part)]
    if option in PAIRS:
        return lambda value: "=" in value
    return _is_number if int in kinds or float in kinds else _anything


def _is_number(value: str) -> bool:
    try:
        float(value)
    except ValueError:
        return False
    return True


def _anything(value: str) -> bool:
    return True


def _repeated(arguments: Sequence[str], syntax: Syntax) -> list[str]:
    """['--crashed', '0', '1'] -> ['--crashed', '0', '--crashed', '1'], behind the verb.

    Raises:
        CliError: an option of free text took what was to be the verb's argument.
    """
    out: list[str] = []
    option, values, given, took = "", 0, 0, ""
    for argument in arguments:
        if argument.startswith("-") and not _is_number(argument):
            option, values = argument, 0
        elif option in syntax.single:
            option = ""
        elif option in syntax.several and (values == 0 or syntax.several[option](argument)):
            values += 1
            if values > 1:
                out.append(option)
                took = option if option in syntax.free else took
        else:
            option = ""
            given += 1
        out.append(argument)
    if took and syntax.argument and given == 0:
        raise CliError(
            f"no {syntax.argument}: {took} takes everything up to the next option; "
            f"give {syntax.argument} first"
        )
    return out
