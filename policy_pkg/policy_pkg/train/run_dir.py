"""A run's directory: what it holds, and that nobody else writes to it.

::

    run.json          config, seed, versions, commit, command line: all it takes to repeat the run
    scenario/         the scenario as it was when the run began (see sim_pkg.scenario_source)
    metrics.jsonl     one line per evaluation block (see metrics)
    timing.jsonl      the clock's figures of the same blocks
    checkpoints/step_000100000/
    best/step_000090000/      the acting half at the best of the run's own evaluation blocks
    tensorboard/, mlflow.json ...    what the experiment loggers leave (see loggers)
"""

from __future__ import annotations

import json
import platform
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from crash_coach_common.contract import UserError
from crash_coach_common.locks import TakenError, held
from crash_coach_common.strict_yaml import ConfigError
from crash_coach_common.whole_output import write_whole
from policy_pkg import native
from policy_pkg.checkpoint import CHECKPOINTS, PolicyBundle, list_checkpoints
from policy_pkg.kernels import kernels
from policy_pkg.train.config import TrainConfig
from policy_pkg.train.offline.config import OfflineConfig
from sim_pkg.env import ScenarioLike
from sim_pkg.scenario_source import ScenarioSource, read_scenario

RUN = "run.json"
METRICS = "metrics.jsonl"
TIMING = "timing.jsonl"
SCENARIO = "scenario"
LENGTHS = ("total_steps", "gradient_steps")  # of a run: trained in the simulator, or offline
FORMAT = "crash-coach-run"
_CURRICULUM = ("curriculum_fraction", "curriculum_delta")  # see _own_settings
RunConfig = TrainConfig | OfflineConfig
LIBRARIES = ("numpy", "torch", "pymunk", "numba")


class RunError(UserError):
    """A run directory that cannot be used as asked."""


def prepare_run(
    out_dir: Path,
    config: RunConfig,
    resume: bool,
    data: dict[str, Any] | None = None,
    scenario: ScenarioSource | None = None,
) -> None:
    """Makes ``out_dir`` a run of ``config``; with ``resume``, one that is there already will do.

    Args:
        data: describes the data set of an offline run, by its ``sha256`` among others.
        scenario: what a new run keeps a copy of.

    Raises:
        RunError: it holds a run and ``resume`` is off; that run has another config (the text
            names the first key that differs) or data set; or ``out_dir`` holds other things.
    """
    described = out_dir / RUN
    if described.exists():
        if not resume:
            raise RunError(
                f"{out_dir} already holds a run: go on with --resume, or choose another directory"
            )
        run = read_run(out_dir)
        check_same(run, config, out_dir)
        _check_same_data(run, data, out_dir)
        return
    # A process that was killed right here leaves .partial files and the scenario.
    if out_dir.is_dir() and any(
        p.suffix != ".partial" and p.name != SCENARIO for p in out_dir.iterdir()
    ):
        raise RunError(f"{out_dir} is not empty and holds no run: choose another directory")
    if out_dir.exists() and not out_dir.is_dir():
        raise RunError(f"{out_dir} is a file: choose another directory")
    about = describe_run(config, data)
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        if scenario is not None:
            file = scenario.write(out_dir / SCENARIO).relative_to(out_dir)
            about["scenario"] = {
                "name": scenario.name,
                "file": file.as_posix(),
                "sha256": scenario.sha256,
            }
        _write_run(out_dir, about)
    except OSError as error:
        raise RunError(f"{out_dir} cannot be written: {error.strerror}") from error


def _write_run(out_dir: Path, about: Mapping[str, Any]) -> None:
    write_whole(out_dir / RUN, (json.dumps(about, indent=1) + "\n").encode())


def kept_scenario(out_dir: Path) -> ScenarioSource | None:
    """The scenario as it was when the run began; None where none is kept: no run, or an old one.

    Raises:
        RunError: the copy is missing or was changed.
    """
    if not (out_dir / RUN).is_file():
        return None
    told = read_run(out_dir).get("scenario")
    if told is None:
        return None
    try:
        source = read_scenario(out_dir / told["file"])
    except ConfigError as error:
        raise RunError(f"{out_dir / RUN} keeps a scenario that is not there: {error}") from error
    if source.sha256 != told["sha256"]:
        raise RunError(
            f"{out_dir / told['file']} is not the scenario that this run was trained on: it was "
            "changed (its sha256 differs): name one with --scenario, or restore the file"
        )
    return replace(source, name=told["name"])


def run_of(checkpoint: Path) -> Path:
    """The run directory that a checkpoint's folder lies in, if it does."""
    return checkpoint.resolve().parent.parent


def scenario_of(bundle: PolicyBundle) -> ScenarioLike:
    """What a policy was trained on: its name where that still means the same, otherwise the copy.

    Raises:
        RunError: the run's copy is damaged.
    """
    kept = kept_scenario(run_of(bundle.path))
    return bundle.scenario if kept is None or is_current(kept) else kept


def is_current(kept: ScenarioSource) -> bool:
    """Whether its name stands for the same here and now, with nothing else to know."""
    now = found_now(kept)
    return now is not None and now.sha256 == kept.sha256


def found_now(kept: ScenarioSource) -> ScenarioSource | None:
    """What its name stands for here and now; None: nothing."""
    try:
        return read_scenario(kept.name)
    except ConfigError:
        return None


def read_run(out_dir: Path) -> dict[str, Any]:
    """The content of ``run.json``.

    Raises:
        RunError: there is none, or it is not one of ours.
    """
    path = out_dir / RUN
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise RunError(f"{out_dir} holds no run: {RUN} is missing") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise RunError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise RunError(f'{path} does not describe a run: no "format": "{FORMAT}"')
    if isinstance(config := content.get("config"), dict):
        if "beta" in config.get("coach", {}):
            config["coach"] = _own_settings(config["coach"])
        if "tensorboard" in config:  # of when it was the only logger
            config["loggers"] = {"tensorboard": config.pop("tensorboard")}
    return content


def _own_settings(coach: Mapping[str, Any]) -> dict[str, Any]:
    """A coach's configuration of when strategies had no settings of their own."""
    kept = {k: v for k, v in coach.items() if k not in ("beta", "rho", "alpha_max", *_CURRICULUM)}
    fraction, delta = (coach[key] for key in _CURRICULUM)
    highest = {} if coach["alpha_max"] is None else {"alpha_max": coach["alpha_max"]}
    curriculum = {"fraction": fraction, **highest}
    if delta is not None:
        curriculum["episodes"] = max(1, round(curriculum.get("alpha_max", 0.1) / delta))
    adaptive = {"beta": coach["beta"], "rho": coach["rho"], **highest}
    return {**kept, "adaptive": adaptive, "curriculum": curriculum}


def describe_run(config: RunConfig, data: dict[str, Any] | None = None) -> dict[str, Any]:
    """What it takes to repeat the run. ``commit`` is null outside a git checkout."""
    return {
        "format": FORMAT,
        "version": 1,
        "config": config.model_dump(mode="json"),
        "seed": config.seed,
        **({} if data is None else {"data": data}),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in LIBRARIES},
        },
        "machine": platform.machine(),
        "kernels": {**kernels(), "learner": native.build_name() or native.TORCH},
        "commit": _commit(),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
    }


def _commit() -> str | None:
    """HEAD of the checkout this file lies in, with "+changes" where files differ from it."""
    folder = Path(__file__).resolve().parent
    command = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--dirty=+changes"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() or None


def check_same(run: Mapping[str, Any], config: RunConfig, out_dir: Path) -> None:
    """Raises RunError where ``out_dir``, which ``run`` describes, was not begun with ``config``.

    A run may be made longer than it was meant to be, see ``extend_run``.
    """
    before = flat(run.get("config", {}))
    now = flat(config.model_dump(mode="json"))
    for key in sorted({*before, *now}):
        old, new = before.get(key, "nothing"), now.get(key, "nothing")
        if key in LENGTHS and isinstance(old, int) and isinstance(new, int) and new > old:
            continue
        if old != new:
            raise RunError(
                f"{out_dir} was started with {key} = {old!r}, not {new!r}: "
                "a run is resumed with the config it was started with"
            )


def extend_run(out_dir: Path, config: RunConfig) -> None:
    """Notes in ``run.json`` that the run is to be longer, where it is; only for who holds it."""
    run = read_run(out_dir)
    now = config.model_dump(mode="json")
    for key in LENGTHS:
        before = run["config"].get(key)
        if key in now and before != now[key]:
            run.setdefault("extended", []).append({key: before})
            run["config"][key] = now[key]
            _write_run(out_dir, run)


def _check_same_data(run: dict[str, Any], data: dict[str, Any] | None, out_dir: Path) -> None:
    if data is None:
        return
    before = run.get("data", {})
    if before.get("sha256") != data["sha256"]:
        raise RunError(
            f"{out_dir} was started with other recordings ({before.get('episodes')} episodes, now "
            f"{data['episodes']}): a run is resumed with the recordings it was started with"
        )


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """{"learner": {"lr": 1}} -> {"learner.lr": 1}"""
    out: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out.update(flat(value, f"{prefix}{key}."))
        else:
            out[prefix + key] = value
    return out


def checkpoint_path(out_dir: Path, env_steps: int, kind: str = CHECKPOINTS) -> Path:
    return out_dir / kind / f"step_{env_steps:09d}"


def newest_step(folder: Path) -> int:
    """Of the newest checkpoint; 0 where there is none."""
    found = list_checkpoints(folder / CHECKPOINTS)
    return int(found[-1].name.removeprefix("step_")) if found else 0


def seedless_name(run: Path) -> str:
    """The folder's name without -s<seed>."""
    return re.sub(r"(?<=.)-s\d+$", "", run.resolve().name)


@contextmanager
def locked(out_dir: Path) -> Iterator[None]:
    """Keeps other processes from training in ``out_dir``; ends with the process at the latest.

    Raises:
        RunError: another process holds it.
    """
    try:
        with held(out_dir / RUN, signed=False):
            yield
    except TakenError:
        raise RunError(f"{out_dir} is being trained by another process") from None
