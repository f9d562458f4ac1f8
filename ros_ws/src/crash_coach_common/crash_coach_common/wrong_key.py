"""What is said of a key or a name that is wrong; for schemas, wherever their values come from."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class Misplaced(ValueError):
    """For a model's checks of several keys together: what is wrong, and below which key.

    ``location`` leads from the model that checks to the key or item that is to blame.
    """

    def __init__(self, location: tuple[int | str, ...], text: str) -> None:
        super().__init__(text)
        self.location = location


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """ " (did you mean 'x'?)" for the closest known name, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {close[0]!r}?)" if close else ""
