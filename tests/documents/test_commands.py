"""Commands in the documents that are too long to execute: every verb and option in them exists."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from crash_coach_bringup.cli.main import repeat_options, typed_app

ROOT = Path(__file__).resolve().parents[2]
# typer carries its own click, under a private name
UsageError: type[Exception] = typer.BadParameter.__mro__[1]
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/**/*.md"))]


def commands(text: str) -> list[list[str]]:
    """The words after `crash-coach` of each command: whole lines, and `code` in a sentence."""
    joined = text.replace("\\\n", " ")
    lines = re.findall(r"^(?:    )?crash-coach (.*)$", joined, flags=re.MULTILINE)
    quoted = re.findall(r"`crash-coach ([^`\n]*)`", joined)
    return [shlex.split(line, comments=True) for line in [*lines, *quoted] if line.strip()]


def parse(words: list[str]) -> None:
    """Raises UsageError for a verb or an option that does not exist."""
    command: Any = typer.main.get_command(typed_app(words))
    context = command.context_class(command)
    words = repeat_options(words)
    while hasattr(command, "resolve_command"):
        name, command, words = command.resolve_command(context, words)
        context = command.context_class(command, info_name=name, parent=context)
        if not words:
            return
    command.make_parser(context).parse_args(args=words)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_verbs_and_options_exist(document: Path) -> None:
    for words in commands(document.read_text()):
        plain = [re.sub(r"^\[|\]$", "", word) for word in words if word != "..."]
        try:
            parse(plain)
        except UsageError as error:
            pytest.fail(f"crash-coach {' '.join(words)}: {error}")


@pytest.mark.parametrize("words", [["trian", "x"], ["train", "--seeed", "1"], ["bags", "inof"]])
def test_the_test_sees_what_does_not_exist(words: list[str]) -> None:
    with pytest.raises(UsageError):
        parse(words)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_nothing_is_left_to_fill_in(document: Path) -> None:
    assert re.findall(r"@[A-Z]+@|\bTODO\b|\bTBD\b|\bFIXME\b", document.read_text()) == []
