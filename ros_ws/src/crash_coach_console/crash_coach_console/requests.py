"""What a page may send: a strict schema per request, and one line for whatever is not one."""

from __future__ import annotations

import json
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from crash_coach_common.contract import UserError
from crash_coach_pkg.plan import NEXT_STEP

MOST_BYTES = 16_384
MOST_ROBOTS = 256
MOST_SOURCES = 16
_SHOWN = 60  # characters of a wrong value

Name = Annotated[str, Field(min_length=1, max_length=100)]
Steps = Annotated[int, Field(ge=0, lt=NEXT_STEP)]


class RequestError(UserError):
    """A message that is no request; ``request_id`` where it names one, otherwise -1."""

    def __init__(self, text: str, request_id: int = -1) -> None:
        super().__init__(text)
        self.request_id = request_id


class _Request(BaseModel):
    """``id``: chosen by the page, names the answer. ``source``: which of those in its hello."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)

    id: int = Field(ge=0, le=2**53 - 1)
    source: int = Field(ge=0, lt=MOST_SOURCES)


class Inject(_Request):
    """Crash robots, now or from the next episode on; those that crash alike already stay."""

    type: Literal["inject"]
    victims: Annotated[tuple[Name, ...], Field(min_length=1, max_length=MOST_ROBOTS)]
    mode: Name
    parameters: Annotated[dict[Name, float], Field(max_length=32)] = {}
    apply_at: Literal["next_step", "next_episode"] = "next_step"
    start_step: Steps = 0
    duration_steps: Steps = 0


class Clear(_Request):
    """End the faults of some robots, or with none named, every fault."""

    type: Literal["clear"]
    robots: Annotated[tuple[Name, ...], Field(max_length=MOST_ROBOTS)] = ()


class Pause(_Request):
    """Let the sim, or a recording, pause or go on."""

    type: Literal["pause"]
    on: bool


class StepOnce(_Request):
    """One control step while paused; back only in a recording."""

    type: Literal["step"]
    by: Literal[1, -1] = 1


class Reset(_Request):
    """End the episode as truncated and start the next."""

    type: Literal["reset"]


class Forget(_Request):
    """Count episodes anew from now on."""

    type: Literal["forget"]


class Seek(_Request):
    """Go to a frame of a recorded episode."""

    type: Literal["seek"]
    frame: int = Field(ge=0, le=2**31)


class Pace(_Request):
    """Play a recorded episode so many times as fast as it was."""

    type: Literal["pace"]
    speed: float = Field(ge=0.05, le=100)


class Choose(_Request):
    """Play another episode of a recording."""

    type: Literal["choose"]
    episode: int = Field(ge=0, lt=2**32)


Request = Inject | Clear | Pause | StepOnce | Reset | Forget | Seek | Pace | Choose
_REQUESTS: TypeAdapter[Request] = TypeAdapter(Annotated[Request, Field(discriminator="type")])


def parse_request(text: str) -> Request:
    """Raises RequestError naming place, value and what would be right."""
    if len(text) > MOST_BYTES:
        raise RequestError(f"a request of {len(text)} characters; at most {MOST_BYTES} are read")
    try:
        return _REQUESTS.validate_json(text)
    except ValidationError as error:
        detail = error.errors(include_url=False)[0]
        place = ".".join(str(part) for part in detail["loc"]) or "request"
        value = repr(detail["input"])
        shown = value if len(value) <= _SHOWN else f"{value[:_SHOWN]}..."
        raise RequestError(f"{place} {shown}: {detail['msg']}", _id_of(text)) from None


def _id_of(text: str) -> int:
    """Of something that is no request, so that the page can tell which of its own was wrong."""
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        return -1
    named = found.get("id") if isinstance(found, dict) else None
    return named if isinstance(named, int) and not isinstance(named, bool) else -1
