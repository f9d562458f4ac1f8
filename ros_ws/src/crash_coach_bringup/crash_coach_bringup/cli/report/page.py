"""The report's tables in Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

from crash_coach_bringup.cli.markdown import table
from crash_coach_bringup.cli.report.findings import Findings
from policy_pkg.play.conditions import when
from policy_pkg.report.coping import Coping
from policy_pkg.report.paired import LEAST_PAIRS, PairedDifference
from policy_pkg.report.rows import ALL_MAPS, Improvement, Row, best
from policy_pkg.report.training import COPES, LAST_BLOCKS
from policy_pkg.report.victims import Cost
from policy_pkg.statistics import Estimate, wilson

NONE = "–"
IMPROVEMENT = (
    "How probable it is that a run of the first method succeeds more often than one of the second "
    "(equal ones count half), over the maps that both have at least three seeds on; 95 % bootstrap."
)
RUNS = (
    "Success in %, and after the comma the mean return. Evaluation episodes are those of a run's "
    "own blocks: as much a part of what a method costs as its training episodes."
)
VICTIMS = (
    "Success in % with this robot alone crashed and, in brackets, what that costs: how much lower "
    "it is than crash-free, in points; ± half the width of its 95 % interval. Who costs most, on "
    "average over the methods, comes first."
)
COPING = (
    f"A block copes where the team succeeds in at least {100 * COPES:.0f} % of its episodes "
    "crash-free and with each robot crashed. In brackets Wilson's interval (95 %) over seeds."
)


def page(findings: Findings) -> str:
    """All tables, and what a reader of them has to know."""
    about, rows, runs = findings.about, findings.rows, findings.runs
    mode = about["mode"]
    if about["parameters"]:
        values = ", ".join(f"{name} = {value:g}" for name, value in about["parameters"].items())
        mode += f" ({values})"
    mode += when(about["start_step"], about["duration_steps"])
    parts = [
        f"Success in % of {about['episodes']} greedy episodes per run and condition (evaluation "
        f"seed {about['seed']}, the same episodes for every run, which no training has played; "
        f"crashed robots: {mode}). " + _checkpoints(runs),
    ]
    if len({row.method for row in rows}) > 1:
        parts += ["## Methods", "Mean ± sample standard deviation over seeds; best in bold."]
        for name, columns, lines in overview(rows):
            parts += [f"### {name}", table(["method", *columns], lines)]
    if findings.costs:
        parts += ["## Who hurts most", VICTIMS, *_victims(findings.costs)]
    if findings.coping:
        parts += ["## When they cope", COPING, coping_table(findings.coping)]
    if about["against"]:
        parts += ["## Differences", *_differences(findings.paired)]
    if findings.improvements:
        parts += [
            "## Probability of improvement",
            IMPROVEMENT,
            _improvements(findings.improvements),
        ]
    parts += ["## Intervals", _meaning(rows), _details(rows)]
    parts += ["## Runs", RUNS, _runs(runs)]
    waiting = [f"{path} has no checkpoint yet: left out." for path in about["without_checkpoint"]]
    parts += [f"- {note}" for note in (*waiting, *notes(rows, runs), *findings.differences)]
    return "\n\n".join(parts) + "\n"


def _checkpoints(runs: Sequence[Mapping[str, Any]]) -> str:
    """Which of a run's checkpoints the figures are of."""
    if all(run["checkpoint"] == "last" for run in runs):
        return "Of every run its last checkpoint acts."
    return (
        "Of runs called METHOD@best the checkpoint acts that was best in the run's own evaluation "
        "blocks, of others the last one; the episodes here are none of those that chose it."
    )


def figure(rate: float) -> str:
    """In %; equal rates look equal, whatever order they were added up in."""
    return f"{round(100 * rate, 9):.1f}"


def percent(row: Row) -> str:
    """'87.5 ± 3.1', without deviation for a single seed and over all maps."""
    return figure(row.mean) if row.std is None else f"{figure(row.mean)} ± {figure(row.std)}"


def span(estimate: Estimate | None) -> str:
    """'30.1..52.9'; an interval without width, of seeds that all score alike, is none."""
    if estimate is None or figure(estimate.low) == figure(estimate.high):
        return NONE
    return f"{figure(estimate.low)}..{figure(estimate.high)}"


def overview(rows: Sequence[Row]) -> list[tuple[str, list[str], list[list[str]]]]:
    """As the paper has it: of each map its name, the conditions and a line of cells per method.

    Victims, which have a table of their own, are not among the conditions.
    """
    bold = best(rows)
    out = []
    for name in dict.fromkeys(row.scenario for row in rows):
        here = [row for row in rows if row.scenario == name and not row.victim]
        conditions = list(dict.fromkeys(row.condition for row in here))
        methods: dict[str, dict[str, str]] = {}
        for row in here:
            text = percent(row)
            if (row.scenario, row.condition, row.method) in bold:
                text = f"**{text}**"
            methods.setdefault(row.method, {})[row.condition] = text
        lines = [[m, *(cells.get(c, NONE) for c in conditions)] for m, cells in methods.items()]
        out.append((name, conditions, lines))
    return out


def _differences(paired: Sequence[PairedDifference]) -> list[str]:
    """A table per condition, pairs of methods down, maps across."""
    if not paired:
        return [f"None: no two methods have {LEAST_PAIRS} seeds in common on a map."]
    maps = list(dict.fromkeys(each.scenario for each in paired))
    out = [
        "In percentage points, of runs with the same seed: mean and Student's t interval (95 %); p "
        "of a mean of zero, corrected by Holm for all comparisons of a table (below 0.05 in bold)."
    ]
    for condition in dict.fromkeys(each.condition for each in paired):
        lines: dict[str, dict[str, str]] = {}
        for each in paired:
            if each.condition == condition:
                middle, half = each.interval.value, each.interval.high - each.interval.value
                text = f"{round(100 * middle, 9):+.1f} ± {figure(half)}".replace("-", "−")
                p = f"p = {each.p:.2g}" if each.p >= 0.001 else "p < 0.001"
                text += f", **{p}**" if each.p < 0.05 else f", {p}"
                lines.setdefault(f"{each.method} − {each.against}", {})[each.scenario] = text
        cells = [[pair, *(of.get(name, NONE) for name in maps)] for pair, of in lines.items()]
        out += [f"### {condition}", table(["difference", *maps], cells)]
    return out


def _victims(costs: Sequence[Cost]) -> list[str]:
    """A table per map: victims down, methods across."""
    out = []
    for name in dict.fromkeys(each.scenario for each in costs):
        here = [each for each in costs if each.scenario == name]
        methods = list(dict.fromkeys(each.method for each in here))
        victims: dict[str, dict[str, str]] = {}
        for each in here:
            cost = f"{round(100 * each.mean, 9):+.1f}"
            if each.interval is not None:
                cost += f" ± {figure((each.interval.high - each.interval.low) / 2)}"
            text = f"{figure(each.success)} ({cost.replace('-', '−')})"
            victims.setdefault(each.victim, {})[each.method] = text
        lines = [[v, *(cells.get(m, NONE) for m in methods)] for v, cells in victims.items()]
        out += [f"### {name}", table(["crashed", *methods], lines)]
    return out


def coping_table(found: Sequence[Coping]) -> str:
    """A line per map and method."""
    lines = []
    for each in found:
        seeds, ended = len(each.seeds), sum(each.at_end)
        steps = sorted(s for s in each.first_steps if s is not None)
        first = NONE
        if steps:
            first = f"{steps[0]:,} to {steps[-1]:,}, median {round(median(steps)):,}"
        if never := seeds - len(steps):
            first = "never" if never == seeds else f"{first}; {never} never"
        around = f"{ended} of {seeds} ({span(wilson(ended, seeds))} %)"
        last = f"{sum(each.last)} of {each.last_blocks}"
        lines.append([each.scenario, each.method, around, last, first])
    columns = ["at the end", f"in the last {LAST_BLOCKS} blocks", "first, steps"]
    return table(["map", "method", *columns], lines)


def _improvements(better: Sequence[Improvement]) -> str:
    """Pairs of methods down, conditions across."""
    conditions = list(dict.fromkeys(each.condition for each in better))
    pairs: dict[str, dict[str, str]] = {}
    for each in better:
        estimate = each.estimate
        text = f"{estimate.value:.2f} ({estimate.low:.2f}..{estimate.high:.2f})"
        pairs.setdefault(f"{each.better} over {each.worse}", {})[each.condition] = text
    lines = [[pair, *(cells.get(c, NONE) for c in conditions)] for pair, cells in pairs.items()]
    return table(["pair", *conditions], lines)


def _meaning(rows: Sequence[Row]) -> str:
    lines = []
    if any(len(row.seeds) > 1 for row in rows):
        lines.append(
            "Intervals (95 %) of the mean are Student's t over training seeds; those of the "
            "interquartile mean (IQM) are a stratified bootstrap over seeds, which with three to "
            "five seeds is too narrow (see Evaluation in docs/algorithms.md). With one episode per "
            "run the former is Wilson's over seeds."
        )
    if any(len(row.seeds) == 1 for row in rows):
        lines.append(
            "Rows of one seed have Wilson's interval over its episodes (re-weighted rows: its "
            "combination over the strata): it says nothing about other training seeds."
        )
    return " ".join(lines)


def _details(rows: Sequence[Row]) -> str:
    lines = []
    for row in rows:
        iqm = NONE
        if row.iqm is not None:
            around = span(row.iqm)
            iqm = figure(row.iqm.value) + ("" if around == NONE else f" ({around})")
        returns = f"{sum(row.returns) / len(row.returns):.2f}" if row.returns else NONE
        place = (row.scenario, row.condition, row.method, len(row.seeds))
        lines.append([*place, percent(row), span(row.interval), iqm, returns])
    columns = ["map", "condition", "method", "seeds", "success", "95 %", "IQM (95 %)", "return"]
    return table(columns, lines)


def _runs(runs: Sequence[Mapping[str, Any]]) -> str:
    names = list(
        dict.fromkeys(
            name for run in runs for name in run["outcomes"] if name not in run["victims"]
        )
    )
    lines = []
    for run in runs:
        alpha = NONE if run["new_alpha"] is None else f"{run['new_alpha']:.2f}"
        learned, played = run["training_episodes"], run["evaluation_episodes"]
        episodes = NONE if learned is None else f"{learned:,} + {played:,}"
        updates = NONE if run["gradient_steps"] is None else f"{run['gradient_steps']:,}"
        cells = [_outcome(run["outcomes"].get(name)) for name in names]
        acts = f"{run['checkpoint']}, {run['checkpoint_steps']:,}"
        head = (
            run["scenario"],
            run["method"],
            run["seed"],
            f"{run['steps']:,}",
            acts,
            episodes,
            updates,
        )
        lines.append([*head, _minutes(run["wall_s"]), alpha, *cells])
    columns = ["map", "method", "seed", "steps", "checkpoint", "episodes: training + evaluation"]
    columns += ["gradient steps", "wall time", "α at the end"]
    return table([*columns, *names], lines)


def _outcome(outcome: Mapping[str, Any] | None) -> str:
    if outcome is None:
        return NONE
    rate = 100 * outcome["successes"] / outcome["episodes"]
    return f"{rate:.1f}, {outcome['return_mean']:.2f}"


def _minutes(wall_s: float | None) -> str:
    return NONE if wall_s is None else f"{wall_s / 60:.0f} min"


def notes(rows: Sequence[Row], runs: Sequence[Mapping[str, Any]]) -> list[str]:
    """What a reader of the figures has to know."""
    out = []
    for run in runs:
        if run["steps"] < run["total_steps"]:
            steps = f"{run['steps']:,} of {run['total_steps']:,} steps"
            out.append(f"{run['run']} is not finished: {steps}.")
    lengths: dict[tuple[str, str], set[int]] = {}
    for run in runs:
        lengths.setdefault((run["scenario"], run["method"]), set()).add(run["steps"])
    for (scenario, method), found in lengths.items():
        if len(found) > 1:
            steps = ", ".join(f"{each:,}" for each in sorted(found))
            out.append(
                f"The seeds of {method} on {scenario} were not trained alike: {steps} steps."
            )
    for row in rows:
        if row.not_measured > 0.001 and row.scenario != ALL_MAPS:
            out.append(
                f"{row.scenario}, {row.condition}: numbers of crashed robots that were not "
                f"measured (probability {100 * row.not_measured:.1f} %) count as failures."
            )
    if any(row.alike for row in rows):
        out.append(
            "Where all episodes of a run went alike and nothing in them is left to chance they are "
            "one episode: a single seed then has no interval, several have Wilson's over seeds."
        )
    if any(row.std == 0 for row in rows):
        out.append(
            "Where all seeds score alike, their interval has no width and is left out: it would be "
            "no certainty."
        )
    return list(dict.fromkeys(out))
