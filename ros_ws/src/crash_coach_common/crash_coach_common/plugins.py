"""What other packages add by name, through entry points."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from crash_coach_common.contract import UserError

T = TypeVar("T")


def load(point: EntryPoint) -> Any:
    """What it names. Raises UserError naming it and its package where that cannot be had."""
    try:
        return point.load()
    except (ImportError, AttributeError) as error:
        raise UserError(f"{place(point)} cannot be loaded: {error}") from error


def place(point: EntryPoint) -> str:
    package = point.dist.name if point.dist is not None else "an unknown package"
    return f"entry point {point.name} = {point.value} ({point.group}) of {package}"


def _accept(point: EntryPoint, check: Callable[[], None]) -> None:
    """Raises UserError naming ``point`` and its package where ``check`` raises ValueError."""
    try:
        check()
    except ValueError as error:
        raise UserError(f"{place(point)} cannot be used: {error}") from error


def with_installed(
    group: str, known: Mapping[str, T], check: Callable[[T, Mapping[str, T]], None]
) -> dict[str, T]:
    """``known``, and after them what an entry point group names: each under its own ``name``.

    Args:
        check: raises ValueError where what was loaded cannot be used beside what is known so far.

    Raises:
        UserError: naming the entry point and its package.
    """
    found = dict(known)
    for point in entry_points(group=group):
        loaded: Any = load(point)
        if loaded in found.values():  # registered before
            continue
        _accept(point, partial(check, loaded, found))
        found[loaded.name] = loaded
    return found


class Plugins(Mapping[str, T]):
    """Ours, then those of an entry point group, which are looked for once and loaded when used.

    Args:
        own: by name; these names cannot be taken.
        check: raises ValueError where what was loaded under a name cannot be used.
    """

    def __init__(self, group: str, own: Mapping[str, T], check: Callable[[str, Any], None]) -> None:
        self.group, self._own, self._check = group, dict(own), check
        self._points: dict[str, EntryPoint] | None = None

    def _installed(self) -> dict[str, EntryPoint]:
        if self._points is None:
            self._points = {
                point.name: point
                for point in entry_points(group=self.group)
                if point.name not in self._own
            }
        return self._points

    def __getitem__(self, name: str) -> T:
        """Raises KeyError; UserError for an entry point that cannot be used."""
        if name not in self._own:
            point = self._installed()[name]
            loaded = load(point)
            _accept(point, partial(self._check, name, loaded))
            self._own[name] = loaded
        return self._own[name]

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys((*self._own, *self._installed())))

    def __len__(self) -> int:
        return len(list(iter(self)))
