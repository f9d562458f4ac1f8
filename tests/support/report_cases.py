"""Runs as training leaves them, for tests of what reads them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from policy_pkg.train.config import TrainConfig
from policy_pkg.train.run_dir import prepare_run
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

WALL_S = (1.0, 30.0, 60.0, 2.0, 20.0)  # of two processes: the second counts from its own start


def write_run(
    folder: Path,
    scenario: str = "buttons",
    seed: int = 0,
    steps: int = 200,
    total_steps: int = 200,
    best: int | None = None,
    **settings: Any,
) -> Path:
    """A run as training leaves it, of a team with random weights; ``best``: steps of best/."""
    config = {"scenario": scenario, "seed": seed, "total_steps": total_steps, **settings}
    prepare_run(folder, TrainConfig.model_validate(config), resume=False)
    line = {"env_steps": steps, "gradient_steps": 7, "new_alpha": 0.25}
    (folder / "metrics.jsonl").write_text(json.dumps(line) + "\n")
    timing = [{"env_steps": k, "wall_s": s, "steps_per_s": 1.0} for k, s in enumerate(WALL_S)]
    (folder / "timing.jsonl").write_text("".join(json.dumps(row) + "\n" for row in timing))
    checkpoint = folder / "checkpoints" / f"step_{steps:09d}"
    spec = make_env(scenario, 1).spec
    write_untrained(checkpoint, spec, seed=seed + 1, hidden=8)
    if best is not None:
        write_untrained(folder / "best" / f"step_{best:09d}", spec, seed=seed + 1001, hidden=8)
    return folder


def results_of(folder: Path) -> dict[str, Any]:
    """What a report wrote to ``folder``."""
    content: dict[str, Any] = json.loads((folder / "results.json").read_text())
    return content
