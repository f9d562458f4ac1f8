"""What a terminal or a pipe cannot show degrades, instead of ending the command."""

from __future__ import annotations

import codecs
import io
import sys

PLAIN = {
    "±": "+/-", "…": "...", "−": "-", "–": "-", "—": "-", "→": "->", "≥": ">=", "≤": "<=",
    "×": "x", "·": "*", "α": "alpha", "β": "beta", "ρ": "rho", "ε": "epsilon", "λ": "lambda",
    "µ": "u", "Δ": "delta", "○": "o", "━": "-", "╸": "-", "╺": "-", "─": "-", "│": "|",
    "‘": "'", "’": "'", "“": '"', "”": '"', "\u00a0": " ",
}  # fmt: skip
_HANDLER = "crash_coach_plain"


def degrade_characters() -> None:
    """Lets standard output and standard error write ``PLAIN``, or ?, for what they cannot encode.

    A name of a file that is no UTF-8 is such a thing even where everything else is UTF-8.
    """
    codecs.register_error(_HANDLER, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_HANDLER)


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    text = error.object[error.start : error.end]
    return "".join(PLAIN.get(character, "?") for character in text), error.end
