"""What a fault is: one robot's faulted stretch of commands or of observations.

A mode is a class with a name, a code, a parameter schema and one method; an object of it lives as
long as the stretch. It sees the robot's commands (or observations) in order, each step once, but
not those of steps in which a later fault of the plan counts instead, and
everything random in it comes from ``Step.bits``: the same plan gives the same effects whatever the
timing. docs/adding_a_fault.md walks through a mode of your own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict

from crash_coach_common.contract import FloatArray
from crash_coach_common.keyed_random import bits_of_one

C = TypeVar("C")
Vector = npt.NDArray[np.float64]
Need = Literal["availability", "sampler", "worst", "vector"]


class FaultParameters(BaseModel):
    """Base of a mode's parameters: numbers, each with a range, a description and a unit.

    Write a field as ``Field(default=..., ge=..., le=..., description="...",
    json_schema_extra={"unit": "steps"})``; "1" is the unit of what has none. ``examples=[...]``
    is for the documentation; without, it shows the default.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True, slots=True)
class Step:
    """One robot's control step."""

    seed: int
    episode: int
    step: int
    robot: int

    def bits(self, stream: int) -> int:
        """64 uniform bits of this robot-step; ``stream`` separates different uses.

        Streams 0..99 are the built-in modes', 100..999 free for others, from 1000 the schedule's.
        """
        return bits_of_one(self.seed, self.episode, self.step, self.robot, stream)

    def uniform(self, stream: int) -> float:
        """In [0, 1), as ``bits``."""
        return (self.bits(stream) >> 11) * 2.0**-53


class Tools(Protocol[C]):
    """What can be done with commands of one type; each only where ``Need`` says it is there."""

    def usable(self, command: C) -> bool:
        """Need availability: whether the robot can execute it now."""
        ...

    def sample(self, bits: int) -> C | None:
        """Need sampler: a uniform command; None: not known what is available yet."""
        ...

    def worst(self) -> C | None:
        """Need worst: the available command that the policy values least; None: not told."""
        ...

    def vector(self, command: C) -> Vector:
        """Need vector: (6,) linear x, y, z in m/s and angular x, y, z in rad/s."""
        ...

    def with_vector(self, command: C, vector: Vector) -> C | None:
        """Need vector: the same command with other velocities; None: no robot should get them."""
        ...


class FaultMode:
    """What every mode declares. ``Parameters`` is its schema."""

    name: ClassVar[str]
    code: ClassVar[int]
    """Of ``Action.fault`` and of recorded episodes: 128..255; below are the built-in modes'."""
    summary: ClassVar[str]
    """One line for the docs: what happens to which topic."""
    Parameters: ClassVar[type[FaultParameters]] = FaultParameters
    needs: ClassVar[frozenset[Need]] = frozenset()
    draws: ClassVar[bool] = False
    """Whether its effects hang on ``Step.bits``: then equal episodes are equal by chance only."""

    def __init__(self, parameters: Any) -> None:
        self.parameters = parameters


class CommandFault(FaultMode, ABC, Generic[C]):
    """Changes or withholds commands."""

    def begin(self, wanted: C | None) -> None:  # most modes need not know
        """Called once, before the first ``apply``.

        Args:
            wanted: what the robot's controller wanted in the step before, whatever became of it;
                None: nothing in this episode yet.
        """

    @abstractmethod
    def apply(self, step: Step, command: C, last: C | None, tools: Tools[C]) -> C | None:
        """What is passed on instead of ``command``; None: nothing, the robot stays.

        Args:
            last: what was last passed on to this robot in the episode; None: nothing yet.
        """
        ...

    def idle(self, step: Step) -> C | None:
        """What is passed on in a step without a command so far; None: nothing.

        Only streams that are not in lock-step have such steps (the relay gate's ticks); a command
        of the same step may still follow. Whatever goes out here must not go out again.
        """
        return None


class ObservationFault(FaultMode, ABC):
    """Changes what the policy sees; the robot itself, and the mask of actions, are untouched."""

    @abstractmethod
    def apply(self, step: Step, features: FloatArray, last: FloatArray | None) -> FloatArray:
        """(O,) what the policy sees instead of ``features``; never written to in place.

        Args:
            last: what it saw in the step before; None: nothing in this episode yet.
        """
        ...
