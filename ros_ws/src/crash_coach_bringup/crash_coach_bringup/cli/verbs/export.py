"""`crash-coach export`: a trained policy for other programs and for robots without a trainer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.output import CliError, console, tell_note
from crash_coach_common.contract import EnvSpec, UserError
from policy_pkg.checkpoint import PolicyBundle
from policy_pkg.export.check import STEPS
from policy_pkg.export.export import Format
from policy_pkg.export.export import export as export_policy
from policy_pkg.play.target import Target, load_target
from policy_pkg.team_name import scripted_name
from sim_pkg.env import make_any_env


def export(
    policy: Annotated[
        str, typer.Argument(metavar="RUN", help="Run directory (RUN@best) or checkpoint directory.")
    ],
    format: Annotated[
        Format, typer.Option(help="What the model is to be; docs/export.md has each one's use.")
    ] = Format.onnx,
    out: Annotated[
        Path, typer.Option(metavar="FOLDER", help="A folder that is new or empty.")
    ] = Path("exported_policy"),
) -> None:
    """Writes a policy as ONNX, safetensors or TorchScript, held against the numpy policy."""
    if scripted_name(policy) is not None:
        raise CliError(f"{policy} is a scripted team: only a trained one can be exported")
    target = load_target(policy, None)
    assert isinstance(target.team, PolicyBundle)
    done = export_policy(target.team, _spec(target), format, out)
    for path in done.files:
        text = f"wrote {path} ({path.stat().st_size:,} bytes)"
        console.print(text, markup=False, highlight=False, soft_wrap=True)
    console.print(
        f"largest difference from the numpy policy in {STEPS:,} steps: action values "
        f"{done.difference.values:.1e}, hidden state {done.difference.hidden:.1e}",
        markup=False,
        highlight=False,
        soft_wrap=True,
    )


def _spec(target: Target) -> EnvSpec | None:
    """Of the team's scenario; None, told, where it is not there: a policy can do without."""
    try:
        return make_any_env(target.source, 1).spec
    except UserError as error:
        tell_note(f"policy.json will have no names of actions: {error}")
        return None
