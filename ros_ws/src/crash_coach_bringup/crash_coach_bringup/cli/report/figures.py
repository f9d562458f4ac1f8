"""The report's figures: success, also against crashed robots, improvement, trajectories, curves."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from crash_coach_bringup.cli.figure_style import COLOURS, FORMATS, INK, mark, save, style
from crash_coach_bringup.cli.output import CliError
from crash_coach_bringup.cli.picture import TeamResults, draw_first_episodes
from crash_coach_bringup.cli.report.curves import learning_curves
from crash_coach_bringup.cli.report.findings import Findings
from crash_coach_bringup.cli.report.panels import COLUMNS, legend_above, panels
from crash_coach_bringup.cli.report.success import in_recordings, success
from crash_coach_bringup.cli.report.victims import victims
from policy_pkg.checkpoint import load_policy
from policy_pkg.play.evaluate import evaluate, evaluation_seed
from policy_pkg.report.finished_runs import Run, methods_of
from policy_pkg.report.kept_evaluations import Result
from policy_pkg.report.rows import ALL_MAPS, THRESHOLDS, Improvement, Profile, Row

BAND = 0.7  # of a number of crashed robots, shared by the methods


def write(findings: Findings, runs: Sequence[Run], out: Path) -> list[Path]:
    """Draws what was found suffices for, as PNG and SVG; returns the files.

    Raises:
        CliError: a file cannot be written.
    """
    rows, better, costs = findings.rows, findings.improvements, findings.costs
    exact = [row for row in rows if row.crashed is not None and row.scenario != ALL_MAPS]
    # One order, and so one colour per method, in all figures.
    methods = methods_of(runs)
    figures: dict[str, Figure] = {}
    if len({row.crashed for row in exact}) > 1:
        figures["resilience"] = resilience(exact, methods)
    if exact:
        figures["success"] = success(exact, in_recordings(runs))
    if costs:
        figures["victims"] = victims(rows, costs, methods)
    if (curves := learning_curves(runs, methods)) is not None:
        figures["curves"] = curves
    if better:
        figures["improvement"] = improvement(better)
    if findings.profiles:
        figures["profile"] = profile(findings.profiles, methods)
    files = []
    for name, figure in figures.items():
        for kind in FORMATS:
            files.append(out / f"{name}.{kind}")
            save(figure, files[-1], kind)
    return files


def resilience(rows: Sequence[Row], methods: Sequence[str]) -> Figure:
    """A panel per map: each method's mean, and the runs it comes from.

    A single seed has Wilson's interval over its episodes instead.

    Args:
        methods: all there are, in the order of their colours.
    """
    maps = list(dict.fromkeys(row.scenario for row in rows))
    figure, axes = panels(len(maps), width=3.4, height=3.2)
    for ax, name in zip(axes, maps, strict=True):
        for index, method in enumerate(methods):
            mine = [row for row in rows if (row.scenario, row.method) == (name, method)]
            _draw_method(ax, mine, index, (index - (len(methods) - 1) / 2) * BAND / len(methods))
        ax.set_title(name, fontsize=11, color=INK)
        ax.set_ylim(-0.03, 1.03)
        numbers = sorted({row.crashed or 0 for row in rows})
        ax.set_xticks(numbers)
        ax.grid(visible=False, axis="x")
        # Bands: what lies beside each other in one belongs to the same number.
        for k in numbers[::2]:
            ax.axvspan(k - 0.5, k + 0.5, color="#f2f2f2", zorder=0)
        ax.set_xlim(numbers[0] - 0.5, numbers[-1] + 0.5)
        ax.set_xlabel("crashed robots", color=INK)
        ax.set_ylabel("success rate", color=INK)
    handles = [
        Line2D([], [], color=style(i)[0], linestyle=style(i)[1], marker=mark(i), label=name)
        for i, name in enumerate(methods)
    ]
    legend_above(figure, handles)
    marks = {"large: mean of the seeds, dashes: each seed": any(len(r.seeds) > 1 for r in rows)}
    marks["bar: Wilson's 95 % interval of a single seed"] = any(len(r.seeds) == 1 for r in rows)
    text = "; ".join(text for text, there in marks.items() if there)
    figure.supxlabel(text, fontsize=8, color=INK)
    return figure


def _draw_method(ax: Any, rows: Sequence[Row], index: int, shift: float) -> None:
    colour, dash = style(index)
    ordered = sorted(rows, key=lambda row: row.crashed or 0)
    places = [(row.crashed or 0) + shift for row in ordered]
    means = [row.mean for row in ordered]
    ax.plot(places, means, dash, color=colour, linewidth=1.0, alpha=0.35, zorder=2)
    ax.plot(places, means, mark(index), color=colour, markersize=7, zorder=3)
    for place, row in zip(places, ordered, strict=True):
        if len(row.seeds) > 1:
            points = [place] * len(row.success)
            ax.plot(points, row.success, "_", color=colour, markersize=9, alpha=0.8, zorder=4)
        elif row.interval is not None:
            error = [[row.mean - row.interval.low], [row.interval.high - row.mean]]
            ax.errorbar(place, row.mean, error, color=colour, capsize=3, linewidth=1)


def improvement(better: Sequence[Improvement]) -> Figure:
    """A panel per condition: how probable it is that the first method's run beats the second's."""
    conditions = list(dict.fromkeys(each.condition for each in better))
    pairs = list(dict.fromkeys((each.better, each.worse) for each in better))
    figure, axes = panels(len(conditions), width=3.0, height=1.0 + 0.3 * len(pairs))
    for ax, condition in zip(axes, conditions, strict=True):
        for each in better:
            if each.condition != condition:
                continue
            place, estimate = pairs.index((each.better, each.worse)), each.estimate
            error = [[estimate.value - estimate.low], [estimate.high - estimate.value]]
            ax.errorbar(estimate.value, place, xerr=error, fmt="o", color=COLOURS[0], capsize=3)
        ax.axvline(0.5, color=INK, linewidth=0.8, linestyle=":")
        ax.set_xlim(-0.03, 1.03)
        ax.set_ylim(len(pairs) - 0.5, -0.5)
        # Panels of one line share the labels of the first.
        labels = [f"{a} over {b}" for a, b in pairs] if axes.index(ax) % COLUMNS == 0 else []
        ax.set_yticks(range(len(pairs)))
        ax.set_yticklabels(labels or [""] * len(pairs), fontsize=8)
        ax.set_title(condition, fontsize=10, color=INK)
    figure.supxlabel("probability of improvement, 95 % bootstrap interval", fontsize=9, color=INK)
    return figure


def profile(found: Sequence[Profile], methods: Sequence[str]) -> Figure:
    """A panel per condition: which share of each method's runs scores more than a success rate."""
    conditions = list(dict.fromkeys(each.condition for each in found))
    figure, axes = panels(len(conditions), width=3.2, height=2.8)
    for ax, condition in zip(axes, conditions, strict=True):
        for each in found:
            if each.condition == condition:
                colour, dash = style(methods.index(each.method))
                ax.step(THRESHOLDS, each.share, dash, where="post", color=colour, linewidth=1.5)
                ax.fill_between(
                    *(THRESHOLDS, each.low, each.high),
                    step="post",
                    color=colour,
                    alpha=0.15,
                    linewidth=0,
                )
        ax.set_xlim(0, 1)
        ax.set_ylim(-0.03, 1.03)
        ax.set_title(condition, fontsize=10, color=INK)
        ax.set_xlabel("success rate", color=INK)
        ax.set_ylabel("share of runs above", color=INK)
    legend_above(
        figure,
        [
            Line2D([], [], color=style(i)[0], linestyle=style(i)[1], label=name)
            for i, name in enumerate(methods)
        ],
    )
    text = "performance profile over seeds and maps; band: 95 % stratified bootstrap"
    figure.supxlabel(text, fontsize=8, color=INK)
    return figure


def trajectories(results: Sequence[Result], run_seed: int, seed: int, out: Path) -> Path:
    """A panel per condition with the first episode of every method's run ``run_seed``.

    Raises:
        CliError: no such run, or on more than one map.
    """
    chosen = [result for result in results if result.run.seed == run_seed]
    maps = {result.run.scenario for result in chosen}
    if len(maps) != 1:
        found = ", ".join(sorted(maps)) or "no run"
        raise CliError(f"--trajectories {run_seed}: runs of that seed on one map; found: {found}")
    methods = methods_of(result.run for result in results)
    teams = []
    for result in chosen:
        bundle = load_policy(result.run.checkpoint)
        scenario = result.run.scenario
        key = evaluation_seed(seed)
        first = [(c, evaluate(bundle, scenario, c, 1, key)) for c, _ in result.outcomes]
        colour, _ = style(methods.index(result.run.method))
        teams.append(TeamResults(result.run.method, colour, bundle, first))
    path = out / "trajectories.png"
    draw_first_episodes(teams, maps.pop(), path)
    return path
