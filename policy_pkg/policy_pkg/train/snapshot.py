"""A session to a checkpoint and back, bit for bit; recordings that it learns from are not saved."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

from pydantic import BaseModel

from policy_pkg.checkpoint import (
    BEST,
    CheckpointError,
    Manifest,
    read_manifest,
    read_tensors,
    write_checkpoint,
)
from policy_pkg.train.metrics import Logged
from policy_pkg.train.run_dir import checkpoint_path

KEEP_LAST = 2


@dataclass(frozen=True)
class Team:
    """What a policy acts for."""

    scenario: str
    robots: tuple[str, ...]
    n_actions: int
    obs_size: int


class Learns(Protocol):
    """What is left of a learner once it has learned."""

    @property
    def updates(self) -> int: ...

    def agent_weights(self) -> Mapping[str, Any]: ...


class Saved(Protocol):
    """What a checkpoint holds of a session.

    ``VERB``: the one that continues its checkpoints. ``counts``: what was done.
    """

    VERB: ClassVar[str]

    @property
    def config(self) -> BaseModel: ...
    @property
    def team(self) -> Team: ...
    @property
    def learner(self) -> Learns: ...
    @property
    def steps(self) -> int: ...
    @property
    def stems(self) -> tuple[str, ...]:
        """Names of the tensor files that continuing needs."""
        ...

    def counts(self) -> dict[str, int | float]: ...

    def state_dict(self) -> tuple[dict[str, dict[str, Any]], dict[str, Any]]:
        """Tensor files by stem, and JSON values."""
        ...

    def load_state_dict(
        self,
        tensors: dict[str, dict[str, Any]],
        values: dict[str, Any],
        counts: dict[str, Any],
    ) -> None:
        """Continues from what ``state_dict`` and ``counts`` gave; for a session not yet used.

        Raises:
            ValueError, KeyError, TypeError: it is of something else, or incomplete.
        """
        ...


def save(out_dir: Path, session: Saved, logged: Logged) -> Path:
    """Writes a checkpoint of ``session`` and removes all but the newest ones.

    Raises:
        OSError: it could not be written; the older ones are untouched.
    """
    tensors, values = session.state_dict()
    folder = checkpoint_path(out_dir, session.steps)
    manifest = _manifest(session, {**values, "logged": vars(logged)})
    write_checkpoint(folder, manifest, tensors, KEEP_LAST)
    return folder


def _manifest(session: Saved, training: dict[str, Any]) -> Manifest:
    return Manifest(
        **vars(session.team),
        config=session.config.model_dump(mode="json"),
        progress=session.counts(),
        training=training,
    )


def save_best(out_dir: Path, session: Saved) -> Path:
    """Keeps the acting half of ``session`` as the run's best, over the one before.

    Raises:
        OSError: it could not be written; the one before is untouched.
    """
    folder = checkpoint_path(out_dir, session.steps, BEST)
    if not folder.exists():  # after a kill the same block is played again, with the same bits
        manifest = _manifest(session, {})
        write_checkpoint(folder, manifest, {"agent": dict(session.learner.agent_weights())}, 1)
    return folder


def restore(folder: Path, session: Saved) -> Logged:
    """Continues from the checkpoint in ``folder``; only for a session not yet used.

    Raises:
        CheckpointError: names the file and what is wrong with it.
    """
    manifest = read_manifest(folder)
    if (verb := _verb(manifest)) != session.VERB:
        raise CheckpointError(f"{folder} is of a run of {verb}, which has to continue it")
    tensors = {stem: read_tensors(folder, manifest, stem) for stem in session.stems}
    values: dict[str, Any] = manifest.training
    try:
        session.load_state_dict(tensors, values, dict(manifest.progress))
        return Logged(**values["logged"])
    except CheckpointError as error:
        raise CheckpointError(f"{folder}: {error}") from error
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(f"{folder} does not fit this run: {error}") from error


def _verb(manifest: Manifest) -> str:
    """Which verb made a checkpoint: only training in one process has episodes under way."""
    if "rollout" in manifest.files:
        return "train"
    return "train-live" if "env_steps" in manifest.progress else "train-offline"
