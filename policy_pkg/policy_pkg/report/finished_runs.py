"""Finished runs: which there are, and what distinguishes them.

Two runs on one map are two seeds of one method where their settings are equal; the seed and the
length of the run are no settings. What a method is called comes from the folders' names.
"""

from __future__ import annotations

import gzip
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from crash_coach_common.natural import natural
from crash_coach_pkg.coach.config import CoachConfig
from policy_pkg.checkpoint import (
    AGENT,
    AT_BEST,
    BEST,
    CHECKPOINTS,
    MANIFEST,
    find_checkpoint,
    list_checkpoints,
    read_manifest,
    split_best,
)
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.offline.config import OfflineConfig
from policy_pkg.train.run_dir import (
    LENGTHS,
    METRICS,
    RUN,
    TIMING,
    RunError,
    flat,
    is_current,
    kept_scenario,
    read_run,
    seedless_name,
)
from sim_pkg.env import ScenarioLike
from sim_pkg.scenario_source import ScenarioSource, short_name

KEPT_BESIDE = {"loggers", "checkpoint_interval_steps", "checkpoint_replay"}
"""What a run keeps, which changes nothing of what it does."""
NO_SETTING = {"scenario", "seed", *LENGTHS, *KEPT_BESIDE}


@dataclass(frozen=True)
class Run:
    """A run and the checkpoint of it that acts; ``agent``: SHA-256 of that one's weights.

    ``settings``: what its method consists of. ``steps``: how far the run has come. ``source``: what
    to make its environment of: the scenario's name, or the copy that the run keeps.
    """

    path: Path
    checkpoint: Path
    method: str
    scenario: str
    seed: int
    settings: Mapping[str, Any]
    steps: int
    total_steps: int
    agent: str
    source: ScenarioLike

    @property
    def finished(self) -> bool:
        return self.steps >= self.total_steps

    @property
    def is_best(self) -> bool:
        """Whether it acts as RUN@best names it, instead of with its newest checkpoint."""
        return self.checkpoint.parent.name == BEST

    @property
    def checkpoint_steps(self) -> int:
        return steps_of(self.checkpoint)


def find_runs(folders: Iterable[Path]) -> list[Path]:
    """Run directories, each given as itself or by the folder it lies in; in order of their names.

    Behind either, @best asks for the runs' best checkpoints; it stays behind their paths.

    Raises:
        RunError: a folder that is no run and holds none.
    """
    found: list[Path] = []
    for given in folders:
        folder, best = split_best(given)
        inside = [folder] if (folder / RUN).is_file() else runs_below(folder)
        if not inside:
            raise RunError(f"{folder}: neither a run nor a folder of runs: no {RUN}, no */{RUN}")
        found += [p.with_name(p.name + AT_BEST) for p in inside] if best else inside
    return list(dict.fromkeys(found))


def runs_below(folder: Path) -> list[Path]:
    """The runs that lie directly in a folder: run-s2 before run-s10."""
    return sorted((p.parent for p in folder.glob(f"*/{RUN}")), key=lambda p: natural(p.name))


def methods_of(runs: Iterable[Run]) -> list[str]:
    """Each method once, in the order of the runs: that of tables and colours."""
    return list(dict.fromkeys(run.method for run in runs))


def has_begun(run: Path) -> bool:
    """Whether there is a checkpoint of it, of RUN@best one that was best."""
    path, best = split_best(run)
    return bool(list_checkpoints(path / (BEST if best else CHECKPOINTS)))


def read_runs(paths: Iterable[Path]) -> list[Run]:
    """Runs with their methods' names, see ``method_name``.

    Where one name would stand for two settings on one map, the name of the folder above is put
    before it.

    Raises:
        CheckpointError: a run without a checkpoint, or a damaged one.
        RunError: a damaged run.json; one name for two settings; the same run twice; a scenario
            that was changed between two runs.
    """
    runs = [_read(path) for path in paths]
    _check_scenarios(runs)
    reason = _clash(runs)
    if reason is None:
        return runs
    longer = [replace(run, method=f"{run.path.resolve().parent.name}/{run.method}") for run in runs]
    if _clash(longer):
        raise RunError(reason)
    return longer


def _check_scenarios(runs: Iterable[Run]) -> None:
    seen: dict[str, Run] = {}
    for run in runs:
        other = seen.setdefault(run.scenario, run)
        if _content(other) != _content(run):
            raise RunError(
                f"{other.path} and {run.path} were both trained on {run.scenario}, but its file "
                "was changed between them: their results cannot stand in one table"
            )


def _content(run: Run) -> str | None:
    """What tells a copy of the scenario from its name's meaning here and now, which is None."""
    return run.source.sha256 if isinstance(run.source, ScenarioSource) else None


def todays_config(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of ``path``'s run with today's keys, whatever version wrote it.

    Raises:
        RunError: it is none.
    """
    model = TrainConfig if "total_steps" in content else OfflineConfig
    try:
        return model.model_validate(content).model_dump(mode="json")
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise RunError(f"{path / RUN}: config.{place}: {first['msg']}") from error


def _read(given: Path) -> Run:
    path, best = split_best(given)
    config = todays_config(path, read_run(path)["config"])
    checkpoint = find_checkpoint(given)
    manifest = read_manifest(checkpoint)
    if AGENT not in manifest.files:
        raise RunError(f"{checkpoint / MANIFEST} lists no {AGENT}.safetensors")
    kept = kept_scenario(path)
    settings = {key: value for key, value in config.items() if key not in NO_SETTING}
    made = [*list_checkpoints(path / BEST), *list_checkpoints(path / CHECKPOINTS)]
    return Run(
        path=path,
        checkpoint=checkpoint,
        method=method_name(path, manifest.scenario, settings) + (AT_BEST if best else ""),
        scenario=manifest.scenario,
        seed=config["seed"],
        settings=settings,
        steps=max(map(steps_of, made)),
        total_steps=wanted_steps(config),
        agent=manifest.files[AGENT].sha256,
        source=manifest.scenario if kept is None or is_current(kept) else kept,
    )


def steps_of(checkpoint: Path) -> int:
    return int(checkpoint.name.removeprefix("step_"))


def wanted_steps(config: Mapping[str, Any]) -> int:
    """How many steps the run is meant to take."""
    return int(next(config[key] for key in LENGTHS if key in config))


def method_name(path: Path, scenario: str, settings: Mapping[str, Any]) -> str:
    """The folder's name without -s<seed> and without the map; else algorithm and strategy.

    ``adaptive-s0`` and ``3m-adaptive-s0`` on skirmish/3m are both "adaptive"; ``3m-s0`` is
    "qmix", or with a coach "qmix, adaptive".
    """
    arena = re.escape(short_name(scenario))
    name = re.sub(rf"(^|[-_.]){arena}(?=$|[-_.])", "", seedless_name(path)).strip("-_.")
    if name:
        return name
    parts = [settings["learner"]["algorithm"]]
    nobody = CoachConfig().strategy
    strategy = settings.get("coach", {}).get("strategy", nobody)
    return ", ".join(parts if strategy == nobody else [*parts, strategy])


def _clash(runs: Sequence[Run]) -> str | None:
    """Why these runs' names cannot stand as they are."""
    settings: dict[tuple[str, str], Run] = {}
    seeds: dict[tuple[str, str, int], Run] = {}
    for run in runs:
        other = settings.setdefault((run.method, run.scenario), run)
        if other.settings != run.settings:
            before, now = flat(other.settings), flat(run.settings)
            key = min(k for k in {*before, *now} if before.get(k) != now.get(k))
            return (
                f"{other.path} and {run.path} would both be called {run.method!r}, but {key} is "
                f"{before.get(key)!r} in one and {now.get(key)!r} in the other: rename a folder"
            )
        other = seeds.setdefault((run.method, run.scenario, run.seed), run)
        if other is not run:
            return (
                f"{other.path} and {run.path} are both {run.method!r} on {run.scenario} with "
                f"seed {run.seed}: give one of them"
            )
    return None


def differences(runs: Sequence[Run]) -> list[str]:
    """What a method was not trained alike in from map to map, a sentence per setting."""
    found = []
    for method in dict.fromkeys(run.method for run in runs):
        maps = {run.scenario: flat(run.settings) for run in runs if run.method == method}
        for key in sorted({key for settings in maps.values() for key in settings}):
            values = {name: repr(settings.get(key)) for name, settings in maps.items()}
            if len(set(values.values())) > 1:
                where = ", ".join(f"{value} on {name}" for name, value in values.items())
                found.append(f"Settings differ between the maps: {key} is {where}.")
    return list(dict.fromkeys(found))


def wall_time_s(run: Path) -> float | None:
    """Seconds a run took, over all processes that had a part in it; None without timing.jsonl.

    Every process counts from its own start, so the parts' last figures are added. What a killed
    process did after its last checkpoint was done again and is not counted.
    """
    total = last = 0.0
    lines = read_lines(run / TIMING)
    for line in lines:
        wall_s = float(line["wall_s"])
        if wall_s < last:  # another process began
            total += last
        last = wall_s
    return total + last if lines else None


def last_metrics(run: Path) -> dict[str, Any]:
    """The last line of a run's metrics; empty where there are none."""
    lines = read_lines(run / METRICS)
    return lines[-1] if lines else {}


def read_text(path: Path) -> tuple[Path, str] | None:
    """The text of ``path``, or of ``path``.gz, which ``collect`` makes, and whose it is; None
    without both.

    Raises:
        RunError: a damaged file.
    """
    packed = path.with_name(path.name + ".gz")
    try:
        if path.is_file():
            return path, path.read_text(encoding="utf-8")
        if packed.is_file():
            path = packed  # for the error below
            return path, gzip.decompress(packed.read_bytes()).decode()
    except (OSError, EOFError, ValueError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    return None


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON lines of ``path`` or ``path``.gz; empty without both.

    Raises:
        RunError: a damaged file or line.
    """
    found = read_text(path)
    if found is None:
        return []
    path, text = found
    try:
        return [json.loads(line) for line in text.splitlines()]
    except ValueError as error:
        raise RunError(f"{path} cannot be read: {error}") from error
