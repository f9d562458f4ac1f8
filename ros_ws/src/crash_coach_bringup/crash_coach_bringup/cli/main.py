"""`crash-coach`: the verbs, and errors turned into one line and an exit code."""

from __future__ import annotations

import os
import signal
import sys
from typing import NoReturn

import typer

from crash_coach_bringup.cli import signals
from crash_coach_bringup.cli.faults import verb as faults
from crash_coach_bringup.cli.multi_value import expand
from crash_coach_bringup.cli.output import surroundings
from crash_coach_bringup.cli.report import verb as report
from crash_coach_bringup.cli.terminal import degrade_characters
from crash_coach_bringup.cli.verbs import (
    bags,
    behaviour,
    calibrate,
    check_scenario,
    collect,
    demo,
    doctor,
    evaluate,
    export,
    gate,
    inject,
    plot,
    profile,
    record,
    render,
    sweep,
    train,
    train_live,
    train_offline,
    up,
)
from crash_coach_common.contract import UserError
from crash_coach_console.command import console

app = typer.Typer(
    name="crash-coach",
    help="Crash robots of a team on purpose: see what it costs, train it away.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
app.command("doctor")(doctor.doctor)
app.command("train")(train.train)
app.command("train-live")(train_live.train_live)
app.command("train-offline")(train_offline.train_offline)
app.command("sweep")(sweep.sweep)
app.command("evaluate")(evaluate.evaluate)
app.command("profile")(profile.profile)
app.add_typer(faults.app, name="faults")
app.command("up")(up.up)
app.command("inject")(inject.inject)
app.command("gate")(gate.gate)
app.command("console")(console)
app.command("record")(record.record)
app.add_typer(bags.app, name="bags")
app.command("demo")(demo.demo)
app.command("plot")(plot.plot)
app.command("collect")(collect.collect)
app.command("report")(report.report)
app.command("behaviour")(behaviour.behaviour)
app.command("export")(export.export)
app.command("render")(render.render)
app.command("calibrate")(calibrate.calibrate)
app.command("check-scenario")(check_scenario.check_scenario)


def repeat_options(arguments: list[str]) -> list[str]:
    """The command line as typer reads it. Raises CliError as ``multi_value.expand``."""
    return expand(arguments, typer.main.get_command(app))


def main() -> None:
    # One thread per process, also where the shell did not say so.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    degrade_characters()
    try:
        with signals.raised():
            app(args=repeat_options(sys.argv[1:]))
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
