"""`crash-coach plot`: learning curves and the coach's crash rate, of several runs and seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from crash_coach_bringup.cli.curves import (
    EACH_CRASHED,
    Curve,
    Group,
    Kind,
    average,
    group_runs,
    last_blocks,
    load_run,
    worst_victim,
)
from crash_coach_bringup.cli.figure_style import (
    FORMATS,
    INK,
    STEPS,
    save,
    style,
)
from crash_coach_bringup.cli.output import (
    CliError,
    check_file_target,
    check_json_target,
    console,
    written_first,
)
from policy_pkg.report.finished_runs import read_text, runs_below
from policy_pkg.report.training import LAST_BLOCKS
from policy_pkg.train.run_dir import METRICS, RUN

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TITLES = {
    "success_rate": "success rate at the run's crash rate α (e_t)",
    "success_crash_free": "success rate without crashes",
    "return_mean": "mean return at the run's crash rate α",
    "alpha": "nominal crash rate α per robot",
    EACH_CRASHED: "success rate with one robot crashed, mean over robots",
    "success_1_crashed": "success rate with one robot crashed",
    "return_crash_free": "mean return without crashes",
    "loss": "loss: what a gradient step lowers",
}
PROBABILITIES = {"success_rate", "success_crash_free", "success_1_crashed", EACH_CRASHED}
WORST = "success_worst_victim"
ENDS = {  # what the right end of a curve is told of
    "success_crash_free": "crash-free",
    "success_1_crashed": "one robot crashed",
    EACH_CRASHED: "each robot crashed alone",
    WORST: "the one that costs most",
}
WIDE_LABEL = 50  # characters from which two columns of the legend would not fit

Curves = dict[str, Curve | None]


def draw(groups: Sequence[Group], curves: Sequence[Curves]) -> Figure:
    """One panel per curve, one line per group, all of one kind; legend and notes below."""
    # Imported here: no other verb should wait for it.
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    rows = len(groups) + sum(note(group) is not None for group in groups)
    figure = Figure(figsize=(10, 6.6 + 0.2 * rows), dpi=160, layout="constrained")
    axes = figure.subplots(2, 2, sharex=True)
    kind = groups[0].runs[0].kind
    for ax, key in zip(axes.flat, shown(kind, curves), strict=True):
        draw_panel(ax, key, groups, [each[key] for each in curves])
    for ax in axes[-1]:
        ax.set_xlabel(STEPS[kind.steps], color=INK)
    handles = [
        Line2D([], [], color=colour, linestyle=dash, label=legend(group))
        for group, (colour, dash) in zip(groups, map(style, range(len(groups))), strict=True)
    ]
    wide = any(len(legend(group)) > WIDE_LABEL for group in groups)
    columns = 1 if wide or len(groups) == 1 else 2
    notes = [text for group in groups if (text := note(group))]
    if notes:
        figure.supxlabel("\n".join(["○ curve ends early", *notes]), fontsize=8, color=INK)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns, frameon=False)
    return figure


def shown(kind: Kind, curves: Sequence[Curves]) -> list[str]:
    """The four figures to draw: what a crash costs, where a run measured it, before the return."""
    left_out = "return_mean" if any(each.get(EACH_CRASHED) for each in curves) else EACH_CRASHED
    return [key for key in kind.curves if key != left_out]


def draw_panel(ax: Any, key: str, groups: Sequence[Group], curves: Sequence[Curve | None]) -> None:
    from matplotlib.ticker import EngFormatter

    ax.grid(color="#dddddd", linewidth=0.6)
    ax.spines[["top", "right"]].set_visible(False)
    ax.xaxis.set_major_formatter(EngFormatter(sep=""))
    if key in PROBABILITIES:
        ax.set_ylim(-0.03, 1.03)
    missing: list[str] = []
    drawn: list[Curve] = []
    for index, (group, curve) in enumerate(zip(groups, curves, strict=True)):
        if curve is None:
            missing.append(group.label)
            continue
        colour, dash = style(index)
        x, y = curve.steps, curve.mean
        under = sum(np.array_equal(y, other.mean) for other in drawn)
        drawn.append(curve)
        # Dashes over a curve that is the same leave both to be seen.
        line: Any = dash if not under else (4.0 * under, (4, 4 * under + 4))
        ax.plot(x, y, linestyle=line, color=colour, linewidth=1.5, zorder=3)
        if curve.low is not None:
            ax.fill_between(x, curve.low, curve.high, color=colour, alpha=0.2, linewidth=0)
        if not group.finished:
            ax.plot(x[-1:], y[-1:], "o", color=colour, markerfacecolor="white", zorder=4)
    if key not in PROBABILITIES and drawn:
        means = np.concatenate([curve.mean for curve in drawn])
        least = float(np.min(means[np.isfinite(means)], initial=math.inf))
        ax.set_ylim(*wide_enough(ax.get_ylim(), least))
    # In the title, where no curve can lie beneath it.
    absent = f"\nnot measured: {', '.join(missing)}" if missing else ""
    ax.set_title(TITLES[key] + absent, fontsize=11, color=INK)


def wide_enough(limits: tuple[float, float], least: float) -> tuple[float, float]:
    """The limits of an axis, wider where a flat curve's last digits would fill it.

    Where the ``least`` value is not negative the axis hardly is: a rate cannot be.
    """
    low, high = limits
    middle = (low + high) / 2
    half = max((high - low) / 2, 0.05, 0.05 * abs(middle))
    low, high = middle - half, middle + half
    return (max(low, -0.03 * high) if least >= 0 else low), high


def legend(group: Group) -> str:
    """'adaptive (5 seeds; band: 95 % bootstrap interval of the mean)'"""
    if group.band is None:
        return f"{group.label} (seed {group.runs[0].seed})"
    return f"{group.label} (mean of {len(group.runs)} seeds; band: {group.band})"


def note(group: Group) -> str | None:
    """Which runs of a group are unfinished, and how far they are; None if all are finished."""
    open_runs = [f"seed {run.seed} at {run.last_step:,}" for run in group.runs if not run.finished]
    if not open_runs:
        return None
    return (
        f"{group.label}: unfinished: {', '.join(open_runs)} of {group.runs[0].total_steps:,} steps"
    )


def ends(group: Group) -> dict[str, list[float]]:
    """Of each run the success in its last LAST_BLOCKS blocks, by curve, in percent."""
    found = {key: last_blocks(group, key) for key in group.runs[0].kind.curves if key in ENDS}
    found[WORST] = worst_victim(group)
    return {key: [100 * rate for rate in rates] for key, rates in found.items() if rates}


def told_ends(group: Group) -> str | None:
    """'last 10 blocks: crash-free 98.6 ± 1.1 % (97.5, 99.8)'; None where there are fewer."""
    told = []
    for key, rates in ends(group).items():
        spread = f" ± {np.std(rates, ddof=1):.1f} %" if len(rates) > 1 else " %"
        each = f" ({', '.join(f'{rate:.1f}' for rate in rates)})" if len(rates) > 1 else ""
        told.append(f"{ENDS[key]} {np.mean(rates):.1f}{spread}{each}")
    return f"last {LAST_BLOCKS} blocks: {'; '.join(told)}" if told else None


def targets(stem: Path) -> dict[str, Path]:
    """Format -> file. A stem that names one of the formats already is taken without it.

    Raises:
        CliError: the folder does not exist, or a directory is in the way.
    """
    name = stem.stem if stem.suffix[1:] in FORMATS else stem.name
    if not name:
        raise CliError(f"--out {stem}: a file name without suffix is needed, such as curves")
    found = {kind: stem.with_name(f"{name}.{kind}") for kind in FORMATS}
    for path in found.values():
        check_file_target("--out", path)
    return found


def as_json(group: Group, curves: Curves) -> dict[str, Any]:
    """What is drawn of a group, in figures; ``low`` and ``high`` are null for a single run."""
    return {
        "label": group.label,
        "band": group.band,
        "config": dict(group.runs[0].config),
        "last_blocks": {"count": LAST_BLOCKS, "success_percent": ends(group)},
        "runs": [
            {
                "path": str(run.path),
                "seed": run.seed,
                run.kind.steps: run.last_step,
                "total_steps": run.total_steps,
                "finished": run.finished,
            }
            for run in group.runs
        ],
        "curves": {
            key: curve and _curve_json(curve, group.runs[0].kind.steps)
            for key, curve in curves.items()
        },
    }


def _curve_json(curve: Curve, steps: str) -> dict[str, list[float] | None]:
    return {
        steps: curve.steps.tolist(),
        "mean": curve.mean.tolist(),
        "low": None if curve.low is None else curve.low.tolist(),
        "high": None if curve.high is None else curve.high.tolist(),
    }


def runs_in(given: Path) -> list[Path]:
    """``given``, or the runs in it that have begun, if it is a folder of such."""
    inside = [] if (given / RUN).is_file() else runs_below(given)
    begun = [path for path in inside if read_text(path / METRICS) is not None]
    return begun or [given]


def plot(
    runs: Annotated[
        list[Path] | None, typer.Argument(metavar="RUN", help="Runs, or folders of runs.")
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE_STEM", help="Writes FILE_STEM.png and FILE_STEM.svg.")
    ] = Path("learning_curves"),
    json: Annotated[Path | None, typer.Option(help="Also write the curves to this file.")] = None,
) -> None:
    """Draws learning curves; runs that differ in nothing but the seed share a line and a band."""
    if not runs:
        raise CliError("no run to plot: name at least one run directory, such as runs/qmix-s0")
    check_json_target(json)
    files = targets(out)
    groups = group_runs([load_run(path) for given in runs for path in runs_in(given)])
    curves: list[Curves] = [
        {key: average(group, key) for key in group.runs[0].kind.curves} for group in groups
    ]
    figure = draw(groups, curves)
    pairs = zip(groups, curves, strict=True)
    result = {
        "files": [str(path) for path in files.values()],
        "groups": [as_json(group, each) for group, each in pairs],
    }
    with written_first(json, result):
        for group in groups:
            console.print(legend(group), markup=False, highlight=False, soft_wrap=True)
            for text in filter(None, (note(group), told_ends(group))):
                console.print(f"  {text}", markup=False, highlight=False, soft_wrap=True)
        for kind, path in files.items():
            save(figure, path, kind)
            console.print(f"wrote {path}", markup=False, highlight=False, soft_wrap=True)
