"""Figures of a fault scenario's report, as PNG."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable
from typing import Any

from matplotlib.figure import Figure

from crash_coach_bringup.cli.figure_style import COLOURS, INK
from crash_coach_pkg.coach.expectations import Outcome
from crash_coach_pkg.faults import is_observation_mode
from policy_pkg.report.verdict import FaultRun
from policy_pkg.statistics import wilson

FREE, FAULTED = COLOURS[0], COLOURS[1]


def figures(run: FaultRun) -> dict[str, bytes]:
    """File name -> PNG."""
    drawn: dict[str, Callable[[FaultRun], Figure]] = {
        "success.png": success,
        "returns.png": returns,
        "timeline.png": timeline,
    }
    return {name: _png(draw(run)) for name, draw in drawn.items()}


def _png(figure: Figure) -> bytes:
    out = io.BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()


def _axes(width: float, height: float) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), dpi=130, layout="constrained")
    ax = figure.subplots()
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax


def success(run: FaultRun) -> Figure:
    """Success rates with Wilson's 95 % intervals, also by how many robots were faulted; without
    where the same episode was played again and again."""
    pairs = run.trials.pairs
    sure = run.crash_free.alike
    groups = [
        ("crash-free", FREE, [p.crash_free.success for p in pairs], sure),
        ("with the faults", FAULTED, [p.faulted.success for p in pairs], run.faulted.alike),
    ]
    counts = sorted({p.crashed for p in pairs})
    if len(counts) > 1:
        for k in counts:
            these = [p.faulted.success for p in pairs if p.crashed == k]
            groups.append((f"{k} faulted", FAULTED, these, sure and k == 0))
    figure, ax = _axes(2 + 1.2 * len(groups), 3.6)
    for place, (_, colour, outcomes, alike) in enumerate(groups):
        rate = wilson(sum(outcomes), len(outcomes))
        error = [[rate.value - rate.low], [rate.high - rate.value]]
        ax.bar(place, rate.value, 0.6, color=colour, alpha=0.75)
        if not alike:
            ax.errorbar(place, rate.value, error, color=INK, capsize=4)
    names = [f"{name}\n({'1 episode' if a else f'n = {len(o)}'})" for name, _, o, a in groups]
    ax.set_xticks(range(len(groups)), names)
    ax.set_ylim(0, 1.05)
    ax.set_ylabel("success rate, 95 % interval", color=INK)
    return figure


def returns(run: FaultRun) -> Figure:
    """Each episode's return with the faults over its return without; areas show equal pairs."""
    figure, ax = _axes(5, 4.8)
    for done, colour in ((True, FREE), (False, FAULTED)):
        points = Counter(
            (p.crash_free.episode_return, p.faulted.episode_return)
            for p in run.trials.pairs
            if p.faulted.success is done
        )
        if points:
            free, faulted = zip(*points, strict=True)
            label = f"{'success' if done else 'no success'} with the faults ({points.total()})"
            sizes = [15 + 400 * count / len(run.trials.pairs) for count in points.values()]
            ax.scatter(free, faulted, sizes, color=colour, alpha=0.6, linewidth=0)
            ax.scatter([], [], 30, color=colour, label=label)
    both = [outcome for pair in run.trials.pairs for outcome in (pair.crash_free, pair.faulted)]
    low, high = (extreme(o.episode_return for o in both) for extreme in (min, max))
    margin = 0.07 * (high - low) or 1.0
    span = (low - margin, high + margin)
    ax.plot(span, span, color=INK, linewidth=0.8, zorder=0)
    ax.set(xlim=span, ylim=span, aspect="equal")
    ax.set_xlabel("return without the faults", color=INK)
    ax.set_ylabel("return with the faults (on the line: they cost nothing)", color=INK)
    figure.legend(loc="outside upper center", frameon=False, fontsize=8)
    return figure


def _ended(outcome: Outcome) -> str:
    done = "success" if outcome.success else "no success"
    return f"{done} after {outcome.steps} steps"


def timeline(run: FaultRun) -> Figure:
    """Which fault was in force on which robot, in the first episode that had one, and its end."""
    effects = [row for row in run.faulted.effects if row.kind == "EFFECT"]
    episode = effects[0].episode if effects else run.faulted.episodes[0].episode
    (steps,) = (e.steps for e in run.faulted.episodes if e.episode == episode)
    robots = run.faulted.robots
    figure, ax = _axes(8, 1.4 + 0.35 * len(robots))
    entries = sorted({(row.entry, row.mode) for row in effects if row.episode == episode})
    for entry, mode in entries:
        at = [r for r in effects if (r.episode, r.entry, r.mode) == (episode, entry, mode)]
        colour = COLOURS[entry % len(COLOURS)]
        lines = [robots.index(row.robot) for row in at]
        left = [row.step for row in at]
        # Thin: an observation and a command may be faulted in the same step.
        height = 0.25 if is_observation_mode(mode) else 0.6
        label = f"{mode} (entry {entry})"
        ax.barh(lines, [1.0] * len(at), height, left, color=colour, label=label)
    ax.set_yticks(range(len(robots)), robots)
    ax.set_ylim(len(robots) - 0.5, -0.5)
    ax.set_xlim(0, max(1, steps))
    ax.set_xlabel("control step", color=INK)
    (pair,) = (pair for pair in run.trials.pairs if pair.episode == episode)
    nothing = "" if entries else "no fault took effect; "
    text = f"episode {episode}: {nothing}{_ended(pair.faulted)}"
    text += f"; crash-free {_ended(pair.crash_free)}"
    ax.set_title(text, fontsize=10, color=INK)
    ax.axvline(steps, color=FREE if pair.faulted.success else FAULTED, linewidth=2)
    if entries:
        ax.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1, 1))
    return figure
