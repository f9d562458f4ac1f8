"""A session to a checkpoint and back, bit for bit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policy_pkg.checkpoint import (
    BEST,
    CheckpointError,
    Manifest,
    read_manifest,
    read_tensors,
    write_checkpoint,
)
from policy_pkg.train.live.session import LiveSession
from policy_pkg.train.metrics import Value
from policy_pkg.train.run_dir import checkpoint_path
from policy_pkg.train.session import Counters, Session

KEEP_LAST = 2


@dataclass(frozen=True)
class Logged:
    """What the run's log files held when the checkpoint was written."""

    metrics_bytes: int = 0
    timing_bytes: int = 0
    last_block: dict[str, Value] | None = None


def save(out_dir: Path, session: Session | LiveSession, logged: Logged) -> Path:
    """Writes a checkpoint of ``session`` and removes all but the newest ones.

    Raises:
        OSError: it could not be written; the older ones are untouched.
    """
    tensors, values = session.state_dict()
    folder = checkpoint_path(out_dir, session.counters.env_steps)
    manifest = _manifest(session, {**values, "logged": vars(logged)})
    write_checkpoint(folder, manifest, tensors, KEEP_LAST)
    return folder


def _manifest(session: Session | LiveSession, training: dict[str, Any]) -> Manifest:
    spec = session.spec
    return Manifest(
        scenario=session.config.scenario,
        robots=spec.robots,
        n_actions=spec.n_actions,
        obs_size=spec.obs_size,
        config=session.config.model_dump(mode="json"),
        progress=session.counters.to_json(),
        training=training,
    )


def save_best(out_dir: Path, session: Session) -> Path:
    """Keeps the acting half of ``session`` as the run's best, over the one before.

    Raises:
        OSError: it could not be written; the one before is untouched.
    """
    folder = checkpoint_path(out_dir, session.counters.env_steps, BEST)
    if not folder.exists():  # after a kill the same block is played again, with the same bits
        manifest = _manifest(session, {})
        write_checkpoint(folder, manifest, {"agent": session.learner.agent_weights()}, 1)
    return folder


def restore(folder: Path, session: Session | LiveSession) -> Logged:
    """Continues from the checkpoint in ``folder``; only for a session not yet used.

    Raises:
        CheckpointError: names the file and what is wrong with it.
    """
    manifest = read_manifest(folder)
    live = isinstance(session, LiveSession)
    if live is ("rollout" in manifest.files):
        verb = "train" if live else "train-live"
        raise CheckpointError(f"{folder} is of a run of {verb}, which has to continue it")
    stems = ["learner"] if live else ["learner", "rollout"]
    stems += ["replay"] if session.config.checkpoint_replay else []
    tensors = {stem: read_tensors(folder, manifest, stem) for stem in stems}
    values: dict[str, Any] = manifest.training
    try:
        counters = Counters(**manifest.progress)  # type: ignore[arg-type]
        session.load_state_dict(tensors, values, counters)
        return Logged(**values["logged"])
    except CheckpointError as error:
        raise CheckpointError(f"{folder}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder} does not fit this run: {error}") from error
