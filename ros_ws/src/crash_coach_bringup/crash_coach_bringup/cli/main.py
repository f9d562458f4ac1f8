"""`crash-coach`: the verbs, and errors turned into one line and an exit code."""

from __future__ import annotations

import importlib
import inspect
import os
import signal
import sys
from importlib.metadata import version
from typing import Annotated, Any, NoReturn

import typer

from crash_coach_bringup.cli import signals
from crash_coach_bringup.cli.multi_value import expand
from crash_coach_bringup.cli.output import surroundings
from crash_coach_bringup.cli.terminal import degrade_characters
from crash_coach_common.contract import UserError
from crash_coach_common.loading import loading

# In the order of --help. A verb's module is loaded where the verb is typed, or nothing known is:
# no verb should wait for what only others need.
VERBS = {
    "doctor": "crash_coach_bringup.cli.verbs.doctor:doctor",
    "train": "crash_coach_bringup.cli.verbs.train:train",
    "train-live": "crash_coach_bringup.cli.verbs.train_live:train_live",
    "train-offline": "crash_coach_bringup.cli.verbs.train_offline:train_offline",
    "sweep": "crash_coach_bringup.cli.verbs.sweep:sweep",
    "evaluate": "crash_coach_bringup.cli.verbs.evaluate:evaluate",
    "profile": "crash_coach_bringup.cli.verbs.profile:profile",
    "faults": "crash_coach_bringup.cli.faults.verb:app",
    "up": "crash_coach_bringup.cli.verbs.up:up",
    "inject": "crash_coach_bringup.cli.verbs.inject:inject",
    "gate": "crash_coach_bringup.cli.verbs.gate:gate",
    "console": "crash_coach_console.command:console",
    "record": "crash_coach_bringup.cli.verbs.record:record",
    "bags": "crash_coach_bringup.cli.verbs.bags:app",
    "demo": "crash_coach_bringup.cli.verbs.demo:demo",
    "plot": "crash_coach_bringup.cli.verbs.plot:plot",
    "collect": "crash_coach_bringup.cli.verbs.collect:collect",
    "report": "crash_coach_bringup.cli.report.verb:report",
    "behaviour": "crash_coach_bringup.cli.verbs.behaviour:behaviour",
    "export": "crash_coach_bringup.cli.verbs.export:export",
    "render": "crash_coach_bringup.cli.verbs.render:render",
    "calibrate": "crash_coach_bringup.cli.verbs.calibrate:calibrate",
    "check-scenario": "crash_coach_bringup.cli.verbs.check_scenario:check_scenario",
}


def make_app(verb: str | None = None) -> typer.Typer:
    """The command with this verb alone, or with all."""
    app = typer.Typer(
        name="crash-coach",
        help="Crash robots of a team on purpose: see what it costs, train it away.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        callback=_options,  # with a single verb, too, the verb has to be typed
    )
    for name in VERBS if verb is None else (verb,):
        module, _, attribute = VERBS[name].partition(":")
        found: Any = getattr(importlib.import_module(module), attribute)
        if isinstance(found, typer.Typer):
            for inner in found.registered_commands:
                inner.short_help = _uncut(inner.callback)
            app.add_typer(found, name=name, short_help=found.info.help)
        else:
            app.command(name, short_help=_uncut(found))(found)
    return app


def _tell_version(asked: bool) -> None:
    if asked:
        typer.echo(f"crash-coach {version('crash_coach_bringup')}")
        raise typer.Exit


def _options(
    asked: Annotated[
        bool,
        typer.Option(
            "--version", callback=_tell_version, is_eager=True, help="Tell the version and exit."
        ),
    ] = False,
) -> None:
    """What the command takes before a verb."""


def _uncut(verb: Any) -> str:
    """The first paragraph of a verb's help: lists of verbs would cut it to one line."""
    return " ".join((inspect.getdoc(verb) or "").partition("\n\n")[0].split())


def typed_app(arguments: list[str]) -> typer.Typer:
    """The command for a command line: with the verb that it begins with, otherwise with all."""
    return make_app(arguments[0] if arguments and arguments[0] in VERBS else None)


def words_typed() -> list[str]:
    """The command line; where a shell asks for its completion, the one that is to be completed."""
    asked = os.environ.get("COMP_WORDS") or os.environ.get("_TYPER_COMPLETE_ARGS")
    if "_CRASH_COACH_COMPLETE" in os.environ and asked:
        return asked.split()[1:]
    return sys.argv[1:]


def repeat_options(arguments: list[str], app: typer.Typer | None = None) -> list[str]:
    """The command line as typer reads it. Raises CliError as ``multi_value.expand``."""
    return expand(arguments, typer.main.get_command(app or typed_app(arguments)))


def main() -> None:
    # One thread per process, also where the shell did not say so.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    degrade_characters()
    try:
        with loading():  # a signal still ends it at once
            app = typed_app(words_typed())
        with signals.raised():
            app(args=repeat_options(sys.argv[1:], app))
    except UserError as error:
        _fail(f"error: {error}")
    except OSError as error:
        text = surroundings(error)
        if text is None:
            raise
        _fail(f"error: {text}")
    except signals.Terminated:
        print(signals.line(signal.SIGTERM), file=sys.stderr)  # noqa: T201
        raise
    except KeyboardInterrupt:
        print(signals.line(signal.SIGINT), file=sys.stderr)  # noqa: T201
        sys.exit(signals.exit_code(signal.SIGINT))
    except SystemExit as end:
        # What typer makes of a KeyboardInterrupt that no verb caught.
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):
            print(signals.line(signal.SIGINT), file=sys.stderr)  # noqa: T201
        raise


def _fail(text: str) -> NoReturn:
    print(f"crash-coach: {text}", file=sys.stderr)  # noqa: T201
    sys.exit(1)


if __name__ == "__main__":
    main()
