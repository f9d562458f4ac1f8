"""`crash-coach profile`: where a training run's time goes, and what to change."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from crash_coach_bringup.cli.output import (
    CliError,
    check_json_target,
    console,
    table,
    written_first,
)
from crash_coach_common.loading import loading
from policy_pkg.train.config import TrainConfig, load_train_config

if TYPE_CHECKING:
    from policy_pkg.train.profile import Profile

WORTH_A_HINT = 0.05
BUSY = 0.9

TITLES = {
    "physics": "physics",
    "simulator": "rest of the simulator",
    "inference": "acting network",
    "rollout": "rest of the rollout",
    "replay": "replay",
    "learner": "learner",
    "coach": "coach",
    "evaluation": "evaluation blocks",
    "checkpoint": "checkpoints",
    "rest": "all else",
}
HINTS = {
    "physics": "the scenario's physics.substeps, as far as it allows; n_envs changes nothing here",
    "simulator": "more n_envs: a call serves all arenas; what remains is the scenario itself",
    "inference": "more n_envs: a call serves all arenas; or a smaller learner.hidden",
    "rollout": "more n_envs: a call serves all arenas",
    "replay": "fewer batch_episodes, or updates_per_episode",
    "learner": "fewer updates_per_episode or batch_episodes, but they change what is learned; "
    "or smaller learner.hidden, learner.mixing_hidden, learner.hypernet_hidden",
    "coach": "nothing to set",
    "evaluation": "a longer test_interval_steps, fewer test_episodes, or test_crash_free=false",
    "checkpoint": "a longer checkpoint_interval_steps, or checkpoint_replay=false",
    "rest": "loggers.tensorboard=false",
}


def show(title: str, result: Profile) -> None:
    columns = ["part", "share", "seconds", "CPU s", "CPU µs/step", "calls"]
    rows = table(title, columns)
    for part, name in TITLES.items():
        rows.add_row(
            name,
            f"{100 * result.share(part):.1f} %",
            f"{result.seconds[part]:.2f}",
            f"{result.cpu_seconds[part]:.2f}",
            f"{result.step_us(part):.1f}",
            f"{result.calls[part]:,}" if result.calls[part] else "-",
        )
    rows.add_section()
    per_step = f"{1e6 * result.cpu_s / result.env_steps:.1f}"
    total = [f"{result.wall_s:.2f}", f"{result.cpu_s:.2f}", per_step, ""]
    rows.add_row("all", "100.0 %", *total)
    console.print(rows)


def summary(result: Profile, config: TrainConfig) -> list[str]:
    """What the table does not say."""
    lines = [
        f"{result.steps_per_s:,.0f} steps/s: {result.env_steps:,} environment steps, "
        f"{result.episodes:,} episodes, {result.gradient_steps:,} gradient steps"
    ]
    if result.gradient_steps:
        learner_ms = 1e3 * result.cpu_seconds["learner"] / result.gradient_steps
        lines[0] += f" of {learner_ms:.1f} ms"
    else:
        lines.append("nothing was learned yet: give it more --seconds")
    busy = result.cpu_s / result.wall_s
    if busy < BUSY:
        lines.append(
            f"this process had a core for {100 * busy:.0f} % of the time only, because other "
            "programs ran or it waited for the disk: go by the CPU's seconds; with a core of its "
            f"own {result.env_steps / result.cpu_s:,.0f} steps/s"
        )
    share = result.evaluation_share(config.test_interval_steps)
    lines.append(
        f"evaluation blocks in this time: {result.blocks}; one takes {result.block_s:.2f} s, which "
        f"every {config.test_interval_steps:,} steps is {100 * share:.1f} % of a long run"
    )
    if not result.calls["checkpoint"]:
        lines.append(
            f"no checkpoint in this time; there is one every {config.checkpoint_interval_steps:,} "
            "steps"
        )
    lines.append(f"the timers took about {100 * result.timers_s / result.cpu_s:.1f} % of it")
    return lines


def hints(result: Profile) -> list[str]:
    """What makes the parts that take the most time faster, the longest first.

    Beside other programs parts are judged by the processor's time: who was interrupted is chance.
    """
    judged = result.seconds if result.cpu_s >= BUSY * result.wall_s else result.cpu_seconds
    total_s = sum(judged.values())
    longest = sorted(TITLES, key=lambda part: -judged[part])
    return [
        f"{TITLES[part]}, {100 * judged[part] / total_s:.0f} %: {HINTS[part]}"
        for part in longest
        if judged[part] >= WORTH_A_HINT * total_s
    ]


def as_json(result: Profile, config: TrainConfig) -> dict[str, Any]:
    parts = {
        part: {
            "share": result.share(part),
            "seconds": result.seconds[part],
            "cpu_seconds": result.cpu_seconds[part],
            "cpu_us_per_step": result.step_us(part),
            "calls": result.calls[part],
        }
        for part in TITLES
    }
    return {
        "parts": parts,
        "wall_s": result.wall_s,
        "cpu_s": result.cpu_s,
        "timers_s": result.timers_s,
        "steps_per_s": result.steps_per_s,
        "env_steps": result.env_steps,
        "episodes": result.episodes,
        "gradient_steps": result.gradient_steps,
        "evaluation_blocks": result.blocks,
        "evaluation_block_s": result.block_s,
        "evaluation_share_of_a_long_run": result.evaluation_share(config.test_interval_steps),
    }


def profile(
    config: Annotated[
        str,
        typer.Argument(help="Configuration: a name such as buttons/qmix, or a YAML file."),
    ],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="key=value ...: replaces settings, e.g. n_envs=32"),
    ] = None,
    seconds: Annotated[
        float,
        typer.Option(help="How long to measure, from the first gradient step on.", min=1, max=3600),
    ] = 30.0,
    seed: Annotated[list[int] | None, typer.Option(help="Seed of the run.")] = None,
    json: Annotated[Path | None, typer.Option(help="Also write the result to this file.")] = None,
) -> None:
    """Tells where a training run's time goes.

    Trains from the start, measures for a while, says what to change. The run is not kept.
    """
    check_json_target(json)
    if seed and len(seed) > 1:
        raise CliError(f"--seed {' '.join(map(str, seed))}: one run takes one seed")
    settings = load_train_config(config, override or [], seed[0] if seed else None)
    # Imported here: the other verbs do without torch.
    with loading():
        from policy_pkg.train.profile import profile as measure

    with console.status("starting") as status:
        result = measure(settings, seconds, tell=status.update)
    about = {"config": settings.model_dump(mode="json")}
    with written_first(json, {**about, **as_json(result, settings)}):
        show(f"{config} on {settings.scenario}, n_envs {settings.n_envs}", result)
        for line in summary(result, settings):
            console.print(line, soft_wrap=True, highlight=False)
        console.print("what to change:")
        for line in hints(result):
            console.print(f"  {line}", soft_wrap=True, highlight=False)
