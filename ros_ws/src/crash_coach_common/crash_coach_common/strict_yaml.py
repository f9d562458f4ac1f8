"""Strict loading of YAML: the only place that reads it.

A wrong file is refused with its name, the line, the key, the value and what would be right;
nothing is guessed and no key is ignored.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from crash_coach_common.contract import UserError
from crash_coach_common.wrong_key import Misplaced as Misplaced
from crash_coach_common.wrong_key import did_you_mean as did_you_mean

_Location = tuple[int | str, ...]


class ConfigError(UserError):
    """A configuration that cannot be used; the text says where, what, and what is right."""


class StrictModel(BaseModel):
    """Base of every configuration: frozen, no unknown key, no NaN, no infinity."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


ModelT = TypeVar("ModelT", bound=BaseModel)


@dataclass(frozen=True)
class YamlTree:
    """A parsed YAML mapping and the line of each of its keys and items."""

    path: Path
    values: dict[str, Any]
    lines: dict[_Location, int]

    def where(self, location: _Location) -> str:
        """``file:line`` of the deepest part of ``location`` that the file contains."""
        for depth in range(len(location), -1, -1):
            line = self.lines.get(location[:depth])
            if line is not None:
                return f"{self.path}:{line}"
        return str(self.path)


class _Loader(yaml.CSafeLoader):
    """libyaml's SafeLoader (PyYAML's own takes ten times as long to read the same), which reads
    1e-3 as a number (YAML 1.2) and not as text (YAML 1.1)."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def load_tree(path: Path) -> YamlTree:
    """Reads a YAML mapping.

    Raises:
        ConfigError: unreadable, not YAML, not a mapping, or a key that occurs twice.
    """
    return parse_tree(path, read_text(path))


def read_text(path: Path) -> str:
    """Raises ConfigError where the file cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text") from error


def parse_tree(path: Path, text: str) -> YamlTree:
    """As ``load_tree``, of what ``path`` holds or would hold."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if not isinstance(node, yaml.MappingNode):
            raise ConfigError(f"{path}: expected a mapping of keys to values")
        lines: dict[_Location, int] = {}
        _index_lines(path, node, (), lines)
        values = loader.construct_document(node)
    except yaml.reader.ReaderError as error:
        number = text.encode().count(b"\n", 0, error.position) + 1
        what = f"control character {chr(error.character)!r}"
        raise ConfigError(f"{path}:{number}: not valid YAML: {what}") from error
    except yaml.MarkedYAMLError as error:
        raise ConfigError(_not_yaml(path, text, error)) from error
    except RecursionError as error:
        raise ConfigError(f"{path}: nested too deeply, or an alias contains itself") from error
    finally:
        loader.dispose()
    return YamlTree(path, values, lines)


def _not_yaml(path: Path, text: str, error: yaml.MarkedYAMLError) -> str:
    what = ", ".join(part for part in (error.context, error.problem) if part)
    if error.problem_mark is None:
        return f"{path}: not valid YAML: {what}"
    number = error.problem_mark.line
    written = [*text.splitlines(), *[""] * (number + 1)][number].strip()
    at = f" in {written!r}" if written else ""
    return f"{path}:{number + 1}: not valid YAML: {what}{at}"


def parse_value(text: str) -> Any:
    """One YAML value, read as in a file: for values on a command line.

    Raises:
        ConfigError: not YAML.
    """
    try:
        return yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise ConfigError(f"{text!r} is not a YAML value") from error


def validate(tree: YamlTree, model: type[ModelT]) -> ModelT:
    """The tree as a model.

    Raises:
        ConfigError: for the first thing that is wrong, with the number of further ones.
    """
    try:
        read = model.model_validate(tree.values)
    except ValidationError as error:
        # A misspelt key is also a missing one: the misspelling says more.
        problems = sorted(
            error.errors(include_url=False), key=lambda p: p["type"] != "extra_forbidden"
        )
        text = _describe(tree, model, dict(problems[0]))
        more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
        raise ConfigError(text + more) from error
    misread = next(_misread(tree.values, read, ()), None)
    if misread is not None:
        raise ConfigError(f"{tree.where(misread[0])}: {misread[1]}")
    return read


_KINDS: dict[type, str] = {bool: "true or false", int: "a number", float: "a number", str: "text"}


def _misread(given: Any, read: Any, location: _Location) -> Iterator[tuple[_Location, str]]:
    """What pydantic took for something else, such as true for 1: where, and what is wrong.

    Its strict mode is no way out: it also refuses a list for a tuple, and 1e6 for an integer.
    """
    if isinstance(given, dict):
        for key, value in given.items():
            inner = read.get(key) if isinstance(read, dict) else getattr(read, str(key), None)
            yield from _misread(value, inner, (*location, key))
    elif isinstance(given, list) and isinstance(read, tuple | list) and len(given) == len(read):
        for index, pair in enumerate(zip(given, read, strict=True)):
            yield from _misread(*pair, (*location, index))
    else:
        written, wanted = _KINDS.get(type(given)), _KINDS.get(type(read))
        if None not in (written, wanted) and written != wanted:
            name = ".".join(str(part) for part in location)
            yield location, f"{name} = {given!r}: {wanted} is needed, not {written}"


def load_yaml_strict(path: Path, model: type[ModelT]) -> ModelT:
    """Reads ``path`` as ``model``.

    Raises:
        ConfigError: the file cannot be read or says something that the model does not allow.
    """
    return validate(load_tree(path), model)


def _index_lines(
    path: Path, node: yaml.Node, location: _Location, lines: dict[_Location, int]
) -> None:
    """Notes the line of every key and item below ``node``; refuses a key given twice."""
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            key: Hashable = getattr(key_node, "value", None)
            here = (*location, str(key))
            line = key_node.start_mark.line + 1
            if here in lines:
                raise ConfigError(f"{path}:{line}: key {key!r} again, first in line {lines[here]}")
            lines[here] = line
            _index_lines(path, value_node, here, lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*location, index)] = item.start_mark.line + 1
            _index_lines(path, item, (*location, index), lines)


def _describe(tree: YamlTree, model: type[BaseModel], problem: dict[str, Any]) -> str:
    location: _Location = problem["loc"]
    name = ".".join(str(part) for part in location) or "the file"
    cause = problem.get("ctx", {}).get("error")
    if isinstance(cause, Misplaced):
        return f"{tree.where((*location, *cause.location))}: {cause}"
    where = tree.where(location)
    if problem["type"] == "extra_forbidden":
        known = _known_keys(model, location[:-1])
        hint = did_you_mean(str(location[-1]), known)
        return f"{where}: unknown key {name!r}{hint}; known keys: {', '.join(known)}"
    if problem["type"] == "missing":
        return f"{where}: key {name!r} is missing"
    message = str(problem["msg"]).removeprefix("Value error, ")
    if isinstance(problem["input"], dict):
        return f"{where}: {message}" if not location else f"{where}: {name}: {message}"
    return f"{where}: {name} = {problem['input']!r}: {message}"


def _known_keys(model: type[BaseModel], location: _Location) -> list[str]:
    """The keys that a model accepts at ``location``."""
    kind: Any = model
    for part in location:
        # An index, or the tag of a union, stays within the same annotation.
        if isinstance(part, str) and part in kind.model_fields:
            kind = _inner_model(kind.model_fields[part].annotation)
        if kind is None:
            return []
    return sorted(kind.model_fields)


def _inner_model(kind: Any) -> type[BaseModel] | None:
    """The model inside an annotation such as ``tuple[Model, ...]`` or ``Model | None``."""
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return kind
    return next((inner for inner in map(_inner_model, get_args(kind)) if inner), None)


def shipped_names(folder: Path) -> tuple[str, ...]:
    """Names of the YAML files below ``folder``, sorted, without their ending."""
    files = folder.rglob("*.yaml")
    return tuple(sorted(f.relative_to(folder).with_suffix("").as_posix() for f in files))


def find_shipped(what: str, folder: Path, name: str | Path) -> Path:
    """The file of a name in ``folder``, or of a path. ``what``: the word for it in errors.

    Raises:
        ConfigError: neither a known name nor an existing file.
    """
    known = shipped_names(folder)
    if isinstance(name, str) and name in known:
        return folder / f"{name}.yaml"
    path = Path(name)
    if path.suffix in {".yaml", ".yml"}:
        if path.is_file():
            return path
        raise ConfigError(f"no {what} file {str(name)!r}")
    raise ConfigError(
        f"unknown {what} {str(name)!r}{did_you_mean(str(name), known)}; "
        f"known: {', '.join(known)}, or the path of a .yaml file"
    )
