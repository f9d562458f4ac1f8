"""What is worth keeping of a finished run."""

from __future__ import annotations

import gzip
import shutil
from pathlib import Path

from policy_pkg.checkpoint import AGENT, BEST, CHECKPOINTS, MANIFEST, list_checkpoints
from policy_pkg.report.finished_runs import steps_of, wanted_steps
from policy_pkg.train.run_dir import METRICS, RUN, SCENARIO, TIMING, RunError, read_run

AGENT_FILES = (f"{AGENT}.safetensors", MANIFEST)


def collect(run: Path, results: Path) -> str | None:
    """Copies what a report and an evaluation need of a finished run to ``results``/<its name>.

    That is run.json, the scenario, the metrics and the timing (compressed), the last agent and the
    best one, where the run kept it: some 100 kB.
    A copy made before is replaced.

    Returns:
        Why nothing was copied, for a run that is not finished; else None.

    Raises:
        RunError: a damaged run, or something else of that name in ``results``.
        OSError: it could not be written.
    """
    wanted = wanted_steps(read_run(run)["config"])
    made = list_checkpoints(run / CHECKPOINTS)
    done = steps_of(made[-1]) if made else 0
    if done < wanted:
        return f"{run}: not finished: checkpoint at {done:,} of {wanted:,} steps"
    kept = results / run.name
    if kept.resolve() == run.resolve() or (kept.exists() and not (kept / RUN).is_file()):
        raise RunError(f"{kept} is not a copy of {run}: choose another folder for the results")
    partial = results / f"{run.name}.partial"
    shutil.rmtree(partial, ignore_errors=True)
    for kept_agent in (made[-1], *list_checkpoints(run / BEST)[-1:]):
        agent = partial / kept_agent.parent.name / kept_agent.name
        agent.mkdir(parents=True)
        for name in AGENT_FILES:
            shutil.copyfile(kept_agent / name, agent / name)
    shutil.copyfile(run / RUN, partial / RUN)
    if (run / SCENARIO).is_dir():
        shutil.copytree(run / SCENARIO, partial / SCENARIO)
    for name in (METRICS, TIMING):
        if (run / name).is_file():
            packed = gzip.compress((run / name).read_bytes(), mtime=0)
            (partial / f"{name}.gz").write_bytes(packed)
    if kept.exists():
        shutil.rmtree(kept)
    partial.rename(kept)
    return None
