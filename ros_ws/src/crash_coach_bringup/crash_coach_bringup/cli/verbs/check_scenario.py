"""`crash-coach check-scenario`: does a scenario keep what scenarios promise?"""

from __future__ import annotations

from typing import Annotated

import typer

from crash_coach_bringup.cli.output import console
from policy_pkg.train.config import load_train_config
from sim_pkg.conformance import check_env
from sim_pkg.env import make_any_env


def check_scenario(
    scenario: Annotated[str, typer.Argument(help="Name, YAML file, or pettingzoo:MODULE:FACTORY.")],
    override: Annotated[
        list[str] | None,
        typer.Option("--set", help="key=value ...: env_args and env_rules, as of train."),
    ] = None,
    episodes: Annotated[int, typer.Option(help="Episodes to play.", min=2, max=1000)] = 4,
    seed: Annotated[int, typer.Option(help="Of the episodes.", min=0)] = 0,
) -> None:
    """Plays a scenario with random actions and says of each promise whether it is kept.

    Exits with 1 where one is not.
    """
    config = load_train_config("buttons/qmix", [f"scenario={scenario}", *(override or [])])
    source = config.scenario_source()
    checks = check_env(lambda arenas: make_any_env(source, arenas), episodes, seed)
    for check in checks:
        word = "ok" if check.kept else "FAILED"
        console.print(
            f"{word:7}{check.name:9}{check.told}", markup=False, highlight=False, soft_wrap=True
        )
    if not all(check.kept for check in checks):
        raise typer.Exit(1)
