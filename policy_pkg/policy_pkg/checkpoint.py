"""Checkpoints: a directory of safetensors files and one JSON file, written whole or not at all.

``checkpoint.json`` holds sizes, config, counters, RNG states and the size and SHA-256 of every
tensor file; ``agent.safetensors`` is all that acting needs. Nothing here needs torch.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from crash_coach_common.contract import EnvSpec, UserError
from policy_pkg.policy import RecurrentPolicy

FORMAT = "crash-coach-checkpoint"
VERSION = 1
MANIFEST = "checkpoint.json"
CHECKPOINTS = "checkpoints"
BEST = "best"
AGENT = "agent"
AT_BEST = "@best"  # behind a run: its best checkpoint

Tensors = dict[str, npt.NDArray[Any]]


class CheckpointError(UserError):
    """A checkpoint that is missing, damaged, foreign, or made for something else."""


class TensorFile(BaseModel):
    """What a tensor file has to be."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    sha256: str
    size_bytes: int


class Manifest(BaseModel):
    """The content of ``checkpoint.json``.

    ``progress`` counts what was done; ``training`` holds what only resuming needs: RNG states,
    the coach, the learner's scalars and the episodes under way.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal["crash-coach-checkpoint"] = "crash-coach-checkpoint"
    version: Literal[1] = 1
    scenario: str
    robots: tuple[str, ...]
    n_actions: int
    obs_size: int
    config: dict[str, Any]
    progress: dict[str, int | float]
    training: dict[str, Any]
    files: dict[str, TensorFile] = {}


@dataclass(frozen=True)
class PolicyBundle:
    """A policy and what it was trained for."""

    policy: RecurrentPolicy
    scenario: str
    robots: tuple[str, ...]
    n_actions: int
    obs_size: int
    path: Path
    meta: dict[str, Any] = field(default_factory=dict)

    def check_spec(self, spec: EnvSpec) -> None:
        """Raises CheckpointError where this policy cannot act in that environment."""
        differing = [
            f"{what}: trained with {mine}, scenario has {theirs}"
            for what, mine, theirs in (
                ("robots", list(self.robots), list(spec.robots)),
                ("actions", self.n_actions, spec.n_actions),
                ("observation features", self.obs_size, spec.obs_size),
            )
            if mine != theirs
        ]
        if differing:
            raise CheckpointError(
                f"{self.path} was trained on {self.scenario!r} and does not fit scenario "
                f"{spec.scenario!r}: {'; '.join(differing)}"
            )


def write_checkpoint(
    folder: Path, manifest: Manifest, tensors: Mapping[str, Tensors], keep_last: int
) -> None:
    """Writes ``folder`` through a temporary sibling, then removes older siblings.

    Args:
        folder: of a name that sorts by age, such as ``step_000010000``; must not exist.
        tensors: file stem -> arrays by name.
        keep_last: how many checkpoints stay, this one counted.

    Raises:
        OSError: it could not be written, for example a full disk; older ones are untouched.
    """
    partial = folder.with_name(folder.name + ".partial")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        _remove(folder.parent.glob("*.partial"))  # what a killed process left
        partial.mkdir()
        files = {stem: _write_tensors(partial, stem, arrays) for stem, arrays in tensors.items()}
        complete = manifest.model_copy(update={"files": files}).model_dump()
        text = json.dumps(complete, indent=1, allow_nan=False)
        _write_synced(partial / MANIFEST, (text + "\n").encode())
        _sync_folder(partial)
        partial.rename(folder)
        _sync_folder(folder.parent)
    except (OSError, SafetensorError) as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError):
            raise
        raise OSError(f"{partial}: {error}") from error
    _remove(list_checkpoints(folder.parent)[:-keep_last])


def _remove(folders: Iterable[Path]) -> None:
    for folder in folders:
        shutil.rmtree(folder)


def _write_tensors(folder: Path, stem: str, arrays: Tensors) -> TensorFile:
    path = folder / f"{stem}.safetensors"
    # safetensors writes an array's memory as it lies, whatever its strides say.
    save_file({name: np.asarray(array, order="C") for name, array in arrays.items()}, path)
    with path.open("rb+") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
    return TensorFile(sha256=digest, size_bytes=path.stat().st_size)


def _write_synced(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def list_checkpoints(folder: Path) -> list[Path]:
    """The complete checkpoints in a run's ``checkpoints`` or ``best`` folder, oldest first."""
    if not folder.is_dir():
        return []
    return sorted(
        p for p in folder.iterdir() if p.name.startswith("step_") and p.suffix != ".partial"
    )


def split_best(path: Path) -> tuple[Path, bool]:
    """A path as a user gives it: ``RUN@best`` is (RUN, True), anything else (itself, False).

    A folder whose own name ends in @best is itself.
    """
    if path.name.endswith(AT_BEST) and path.name != AT_BEST and not path.exists():
        return path.with_name(path.name.removesuffix(AT_BEST)), True
    return path, False


def find_checkpoint(path: Path) -> Path:
    """The checkpoint directory that ``path`` stands for.

    Args:
        path: one itself, a run directory (its newest counts), or RUN@best, the one that was best in
            the run's own evaluation blocks.

    Raises:
        CheckpointError: there is none.
    """
    path, best = split_best(path)
    if not path.exists():
        raise CheckpointError(f"{path}: no such file or directory")
    if best:
        kept = list_checkpoints(path / BEST)
        if kept:
            return kept[-1]
        raise CheckpointError(
            f"{path}{AT_BEST}: {path / BEST}/step_*/ is not there: the run kept no best checkpoint"
        )
    if (path / MANIFEST).is_file():
        return path
    found = list_checkpoints(path / CHECKPOINTS)
    if found:
        return found[-1]
    raise CheckpointError(
        f"{path} holds no checkpoint: neither {MANIFEST} nor {CHECKPOINTS}/step_*/ is there"
    )


def read_manifest(folder: Path) -> Manifest:
    """Raises CheckpointError where ``checkpoint.json`` is missing, foreign or damaged."""
    path = folder / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CheckpointError(f"{path} is missing") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise CheckpointError(f'{path} is not a Crash Coach checkpoint: no "format": "{FORMAT}"')
    if content.get("version") != VERSION:
        raise CheckpointError(
            f"{path} has version {content.get('version')}, this program reads version {VERSION}"
        )
    try:
        return Manifest.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        raise CheckpointError(f"{path}: {place}: {first['msg']}") from error


def read_tensors(folder: Path, manifest: Manifest, stem: str) -> Tensors:
    """Loads one tensor file after holding it against its recorded size and SHA-256.

    Raises:
        CheckpointError: missing, truncated or changed.
    """
    path = folder / f"{stem}.safetensors"
    if stem not in manifest.files:
        raise CheckpointError(f"{folder / MANIFEST} lists no {path.name}")
    expected = manifest.files[stem]
    try:
        size = path.stat().st_size
        if size != expected.size_bytes:
            raise CheckpointError(
                f"{path} has {size} bytes, {expected.size_bytes} were written: truncated or changed"
            )
        with path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if digest != expected.sha256:
            raise CheckpointError(
                f"{path} is damaged: its sha256 is {digest[:12]}..., "
                f"{expected.sha256[:12]}... was written"
            )
        return dict(load_file(path))
    except FileNotFoundError:
        raise CheckpointError(f"{path} is missing") from None
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"{path} cannot be read: {error}") from error


def load_policy(path: str | Path) -> PolicyBundle:
    """Loads the acting half of a checkpoint.

    Args:
        path: as of ``find_checkpoint``.

    Raises:
        CheckpointError: names the file and what is wrong with it.
    """
    folder = find_checkpoint(Path(path))
    manifest = read_manifest(folder)
    weights = read_tensors(folder, manifest, AGENT)
    try:
        policy = RecurrentPolicy(weights, len(manifest.robots), manifest.n_actions)
    except ValueError as error:
        raise CheckpointError(f"{folder / AGENT}.safetensors: {error}") from error
    if policy.sizes.obs != manifest.obs_size:
        raise CheckpointError(
            f"{folder / AGENT}.safetensors is for {policy.sizes.obs} observation features, "
            f"{MANIFEST} says {manifest.obs_size}"
        )
    return PolicyBundle(
        policy=policy,
        scenario=manifest.scenario,
        robots=manifest.robots,
        n_actions=manifest.n_actions,
        obs_size=manifest.obs_size,
        path=folder,
        meta={"config": manifest.config, "progress": manifest.progress},
    )
