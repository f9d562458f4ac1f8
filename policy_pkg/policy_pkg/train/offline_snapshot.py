"""An offline session to a checkpoint and back, bit for bit; the data set itself is not saved."""

from __future__ import annotations

from pathlib import Path

from policy_pkg.checkpoint import (
    CheckpointError,
    Manifest,
    read_manifest,
    read_tensors,
    write_checkpoint,
)
from policy_pkg.train.offline.session import OfflineSession
from policy_pkg.train.run_dir import checkpoint_path
from policy_pkg.train.snapshot import KEEP_LAST, Logged

UNKNOWN_SCENARIO = "unknown"


def save(out_dir: Path, session: OfflineSession, logged: Logged) -> Path:
    """Writes a checkpoint of ``session`` and removes all but the newest ones.

    Raises:
        OSError: it could not be written; the older ones are untouched.
    """
    sizes = session.data.sizes
    tensors, values = session.state_dict()
    manifest = Manifest(
        scenario=session.config.scenario or UNKNOWN_SCENARIO,
        robots=session.data.robots,
        n_actions=sizes.n_actions,
        obs_size=sizes.obs_size,
        config=session.config.model_dump(mode="json"),
        progress=session.progress(),
        training={**values, "logged": vars(logged)},
    )
    folder = checkpoint_path(out_dir, session.gradient_steps)
    write_checkpoint(folder, manifest, tensors, KEEP_LAST)
    return folder


def restore(folder: Path, session: OfflineSession) -> Logged:
    """Continues from the checkpoint in ``folder``; only for a session not yet used.

    Raises:
        CheckpointError: names the file and what is wrong with it.
    """
    manifest = read_manifest(folder)
    learner = read_tensors(folder, manifest, "learner")
    try:
        session.load_state_dict(learner, manifest.training, manifest.progress)
        return Logged(**manifest.training["logged"])
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder} does not fit this run: {error}") from error
