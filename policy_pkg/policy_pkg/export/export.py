"""A checkpoint's policy as a folder of its own: the model in one of three formats, policy.json."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from crash_coach_common.contract import EnvSpec, UserError
from policy_pkg.checkpoint import (
    AGENT,
    MANIFEST,
    PolicyBundle,
    load_policy,
    read_manifest,
    read_tensors,
)
from policy_pkg.export.about import ABOUT, About, describe
from policy_pkg.export.check import Difference, Step, compare
from policy_pkg.policy import WeightArrays

ROUNDING = 1e-5  # a model that differs by more is wrong: numpy itself rounds by 2e-6


class Format(StrEnum):
    onnx = "onnx"
    safetensors = "safetensors"
    torchscript = "torchscript"


MODELS = {
    Format.onnx: "policy.onnx",
    Format.safetensors: f"{AGENT}.safetensors",
    Format.torchscript: "policy.pt",
}


class ExportError(UserError):
    """A folder that cannot be exported to."""


@dataclass(frozen=True)
class Exported:
    """``files``: what was written. ``difference``: from the numpy policy, by ``check.compare``."""

    files: tuple[Path, ...]
    difference: Difference


def export(bundle: PolicyBundle, spec: EnvSpec | None, kind: Format, out: Path) -> Exported:
    """Writes ``out`` whole or not at all, after the model was played against the numpy policy.

    Args:
        spec: as of ``describe``.

    Raises:
        ExportError: ``out`` holds something already, or cannot be written.
        CheckpointError: a damaged checkpoint.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ExportError(f"{out} is there already: choose a folder that is new or empty")
    about = describe(bundle, spec, MODELS[kind])
    partial = out.with_name(f"{out.name}.partial")
    try:
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        (partial / ABOUT).write_text(about.model_dump_json(indent=1) + "\n", encoding="utf-8")
        difference = _write_model(bundle, about, kind, partial)
        if out.exists():
            out.rmdir()
        partial.rename(out)
    except OSError as error:
        raise ExportError(f"{out} cannot be written: {error.strerror or error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return Exported(tuple(sorted(out.iterdir())), difference)


def _write_model(bundle: PolicyBundle, about: About, kind: Format, folder: Path) -> Difference:
    """Returns how far the model that was written is from the numpy policy."""
    manifest = read_manifest(bundle.path)
    weights = read_tensors(bundle.path, manifest, AGENT)
    path = folder / about.model
    if kind is Format.safetensors:
        # A checkpoint without what only training needs: policy nodes load it as it is.
        shutil.copyfile(bundle.path / path.name, path)
        files = {AGENT: manifest.files[AGENT]}
        acting = manifest.model_copy(update={"files": files, "training": {}})
        (folder / MANIFEST).write_text(acting.model_dump_json(indent=1) + "\n", encoding="utf-8")
    else:
        path.write_bytes(_model(weights, about, kind))
    difference = compare(bundle.policy, _loaded(path, kind))
    if difference.largest > ROUNDING:
        raise AssertionError(f"{about.model} is not the numpy policy: {difference}")
    return difference


def _model(weights: WeightArrays, about: About, kind: Format) -> bytes:
    # Each with the library that it needs: a robot exports nothing and has neither.
    if kind is Format.onnx:
        from policy_pkg.export.onnx_model import to_onnx

        return to_onnx(weights, about)
    from policy_pkg.export.torchscript import to_torchscript

    return to_torchscript(weights, about)


def _loaded(path: Path, kind: Format) -> Step:
    """The model in ``path`` as anybody runs it."""
    if kind is Format.onnx:
        from policy_pkg.export.onnx_model import run_onnx

        return run_onnx(path)
    if kind is Format.torchscript:
        from policy_pkg.export.torchscript import run_torchscript

        return run_torchscript(path)
    return load_policy(path.parent).policy.forward
