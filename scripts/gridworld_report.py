"""Tables and figures of docs/results/gridworld.md from finished runs.

    python scripts/gridworld_report.py collect runs/gridworld results/gridworld
    python scripts/gridworld_report.py report results/gridworld runs/gridworld_report

``collect`` keeps of every finished run what a report and an evaluation need: run.json, the
metrics (compressed) and the last agent. ``report`` evaluates every team crash-free and with each
robot still, and writes table.md, results.json and trajectories.png.
"""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from crash_coach_bringup.cli.output import write_json
from crash_coach_bringup.cli.picture import TeamResults, draw_first_episodes
from policy_pkg.checkpoint import AGENT, CHECKPOINTS, MANIFEST, load_policy
from policy_pkg.train.evaluate import Condition, Evaluation, crash_free, evaluate, named
from policy_pkg.train.run_dir import METRICS, RUN
from policy_pkg.train.statistics import bootstrap_interquartile_mean, wilson

SCENARIO = "buttons"
CONDITIONS = (crash_free(), named(["robot_1"], "stay"), named(["robot_2"], "stay"))
AGENT_FILES = (f"{AGENT}.safetensors", MANIFEST)
COLOURS = {"qmix": "#d1495b", "adaptive": "#00798c"}  # of the methods that are drawn
app = typer.Typer(add_completion=False, no_args_is_help=True)


@app.command()
def collect(runs: Path, results: Path) -> None:
    """Copies what is kept of every finished run of RUNS to RESULTS."""
    for run in sorted(path.parent for path in runs.glob(f"*/{RUN}")):
        wanted = json.loads((run / RUN).read_text())["config"]["total_steps"]
        last = max((run / CHECKPOINTS).glob("step_*"), default=None)
        if last is None or int(last.name.removeprefix("step_")) < wanted:
            typer.echo(f"{run}: not finished, left out")
            continue
        kept = results / run.name
        shutil.rmtree(kept, ignore_errors=True)
        agent = kept / CHECKPOINTS / last.name
        agent.mkdir(parents=True)
        for name in AGENT_FILES:
            shutil.copyfile(last / name, agent / name)
        shutil.copyfile(run / RUN, kept / RUN)
        packed = gzip.compress((run / METRICS).read_bytes(), mtime=0)
        (kept / f"{METRICS}.gz").write_bytes(packed)


@app.command()
def report(
    results: Path, out: Path, figure_seed: Annotated[int, typer.Option(help="Seed drawn.")] = 0
) -> None:
    """Evaluates every team below RESULTS named METHOD-sSEED; table, JSON and figure in OUT."""
    runs: dict[str, dict[int, Path]] = {}
    for path in sorted(results.glob(f"*-s*/{RUN}")):
        method, seed = path.parent.name.rsplit("-s", 1)
        runs.setdefault(method, {})[int(seed)] = path.parent
    if not runs:
        raise typer.BadParameter(f"{results}: no run named METHOD-sSEED; `collect` makes them")
    drawn = [(m, c) for m, c in COLOURS.items() if figure_seed in runs.get(m, {})]
    if not drawn:
        raise typer.BadParameter(f"--figure-seed {figure_seed}: no run of {' or '.join(COLOURS)}")
    out.mkdir(parents=True, exist_ok=True)
    played = {
        method: {seed: _evaluate(run) for seed, run in seeds.items()}
        for method, seeds in runs.items()
    }
    rows = [_row(method, runs[method], played[method]) for method in runs]
    write_json(out / "results.json", {"methods": rows})
    table = _table(rows)
    (out / "table.md").write_text(table)
    typer.echo(table)
    teams = [
        TeamResults(m, colour, load_policy(runs[m][figure_seed]), played[m][figure_seed])
        for m, colour in drawn
    ]
    draw_first_episodes(teams, SCENARIO, out / "trajectories.png")


def _evaluate(run: Path) -> list[tuple[Condition, Evaluation]]:
    """One episode per condition: starts, buttons and greedy policies are deterministic."""
    bundle = load_policy(run)
    return [(c, evaluate(bundle, SCENARIO, c, episodes=1, seed=0)) for c in CONDITIONS]


def _row(
    method: str, runs: dict[int, Path], played: dict[int, list[tuple[Condition, Evaluation]]]
) -> dict[str, Any]:
    row: dict[str, Any] = {"method": method, "seeds": sorted(runs)}
    for index, condition in enumerate(CONDITIONS):
        episodes = [played[seed][index][1].episodes[0] for seed in sorted(runs)]
        returns = np.array([[e.episode_return] for e in episodes])
        mean = bootstrap_interquartile_mean(returns, np.random.default_rng(0))
        success = wilson(sum(e.success for e in episodes), len(episodes))
        row[condition.name] = {
            "successes": sum(e.success for e in episodes),
            "success_ci95": [success.low, success.high],
            "returns": returns[:, 0].tolist(),
            "return_iqm": mean.value,
            "return_iqm_ci95": [mean.low, mean.high],
            "steps": [e.steps for e in episodes],
        }
    ends = [_last_metrics(runs[seed]) for seed in sorted(runs)]
    row["alpha"] = [line["new_alpha"] for line in ends]
    row["gradient_steps"] = [line["gradient_steps"] for line in ends]
    return row


def _last_metrics(run: Path) -> dict[str, Any]:
    with gzip.open(run / f"{METRICS}.gz", "rt") as lines:
        *_, last = lines
    values: dict[str, Any] = json.loads(last)
    return values


def _table(rows: Sequence[dict[str, Any]]) -> str:
    names = [condition.name for condition in CONDITIONS]
    lines = [
        f"| method | seeds | {' | '.join(names)} | α at the end | gradient steps |",
        "|---" * (len(names) + 4) + "|",
    ]
    for row in rows:
        cells = [_cell(row[name], len(row["seeds"])) for name in names]
        alphas = ", ".join(f"{a:.2f}" for a in row["alpha"])
        mean_steps = f"{np.mean(row['gradient_steps']):,.0f}"
        head = f"| {row['method']} | {len(row['seeds'])}"
        lines.append(f"{head} | {' | '.join(cells)} | {alphas} | {mean_steps} |")
    return "\n".join(lines) + "\n"


def _cell(result: dict[str, Any], seeds: int) -> str:
    low, high = result["success_ci95"]
    returns = ", ".join(f"{value:g}" for value in result["returns"])
    return f"{result['successes']} of {seeds} ({100 * low:.0f}..{100 * high:.0f} %): {returns}"


if __name__ == "__main__":
    app()
