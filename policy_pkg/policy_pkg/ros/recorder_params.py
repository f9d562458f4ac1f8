"""The recorder's parameters: one strict model, declared from it and validated by it."""

from __future__ import annotations

import re
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.parameters import read_model, require

_NOT_TOLD = -1
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class RecorderParameters(BaseModel):
    """Read once at start-up. What describes the team goes into the recording as it is told."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    out: str = Field("", description="folder of the recording; must not exist, or be empty")
    robots: list[str] = Field([""], description="names of the team's robots, in order")
    scenario: str = Field("", description="name or path of the scenario")
    seed: int = Field(_NOT_TOLD, ge=-1, le=2**63 - 1, description="of the sim; -1: not told")
    mode: Literal["lockstep", "realtime"] = Field("lockstep", description="of the sim")
    stay_actions: list[int] = Field([_NOT_TOLD], description="no-move actions; -1: not told")
    dt_s: float = Field(0.0, ge=0, le=3600, description="control step; 0: not told")
    episode_limit: int = Field(0, ge=0, le=10**6, description="longest episode; 0: not told")
    odometry: bool = Field(False, description="also record odom; the sim then has to build it")
    split_bytes: int = Field(1 << 30, ge=0, le=2**40, description="new file after; 0: never")
    split_episodes: int = Field(0, ge=0, le=10**9, description="new file after; 0: never")
    compression: Literal["zstd", "lz4", "none"] = Field("zstd", description="of the chunks")
    queue_messages: int = Field(
        100_000, ge=1, le=10**7, description="most messages that wait to be written"
    )
    episodes: int = Field(0, ge=0, le=10**9, description="end after so many; 0: run on")


def read_parameters(node: Node) -> RecorderParameters:
    """Declares the parameters on ``node`` and returns what was set on the command line.

    Raises:
        UserError: an unknown name, a wrong type, a value out of range, or no out or robots.
    """
    parameters = read_model(node, RecorderParameters)
    require(node, parameters, "out", "robots")
    robots = parameters.robots
    if len(set(robots)) != len(robots) or not all(map(_NAME.fullmatch, robots)):
        raise UserError(
            f"parameter robots = {robots}: every robot needs a name of its own, of letters, "
            "digits and _, which does not begin with a digit"
        )
    return parameters
