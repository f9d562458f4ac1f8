"""The sim node's parameters: one strict model, declared from it and validated by it."""

from __future__ import annotations

from typing import Literal

from pydantic import ConfigDict, Field
from rclpy.node import Node

from crash_coach_common.ros.parameters import read_model
from crash_coach_common.strict_yaml import StrictModel


class SimParameters(StrictModel):
    """Read once at start-up; the node's parameters are read-only afterwards."""

    model_config = ConfigDict(strict=True)  # true is no seed, and 1 no switch

    scenario: str = Field("buttons", description="name of a shipped scenario, or path of a YAML")
    mode: Literal["lockstep", "realtime"] = Field(
        "lockstep", description="lockstep: waits for every robot; realtime: a steady clock"
    )
    seed: int = Field(0, ge=0, le=2**63 - 1, description="episodes are keyed by (seed, episode)")
    first_episode: int = Field(0, ge=0, le=2**31, description="number of the first episode")
    episodes: int = Field(0, ge=0, le=2**31, description="exit after so many; 0: endless")
    autostart: bool = Field(True, description="false: /sim/reset starts each episode")
    resend_after_s: float = Field(
        0.25, gt=0, le=60, description="lockstep: send an observation again after this silence"
    )
    max_resends: int = Field(
        20, ge=0, le=100_000, description="lockstep: then the episode ends as an error"
    )
    pace_hz: float = Field(
        0.0, ge=0, le=1000, description="lockstep: most control steps per second; 0: no limit"
    )
    match_timeout_s: float = Field(
        30.0, gt=0, le=3600, description="longest wait for every robot's publisher and subscriber"
    )
    cmd_timeout_s: float = Field(
        0.0, ge=0, le=3600, description="realtime: age at which a command is void; 0: 3 dt"
    )
    real_time_factor: float = Field(
        1.0, gt=0, le=1000, description="realtime: simulated seconds per second"
    )
    arena_hz: float = Field(
        30.0, gt=0, le=1000, description="most messages per second on /sim/arena_state"
    )


def read_parameters(node: Node) -> SimParameters:
    """Declares the parameters on ``node``, serves them (made without rclpy's own services), and
    returns what was set on the command line.

    Raises:
        UserError: an unknown name, a wrong type, NaN, or a value out of range.
    """
    return read_model(node, SimParameters)
