"""The trainer's parameters: one strict model, declared from it and validated by it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.parameters import read_model, require

OWN_DOMAIN = -1
NOTHING = "none"


class TrainerParameters(BaseModel):
    """Read once at start-up."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    config: str = Field("", description="training configuration: name or path of a YAML file")
    out: str = Field("", description="run directory")
    overrides: list[str] = Field([NOTHING], description="key=value each; ['none']: nothing")
    seed: int = Field(-1, ge=-1, le=2**63 - 1, description="replaces the configuration's; -1: not")
    resume: bool = Field(False, description="continue the run in out, if there is one")
    mode: Literal["lockstep", "realtime"] = Field("lockstep", description="of the graphs' sims")
    domains: list[int] = Field(
        [OWN_DOMAIN], description="ROS domain of each graph, as many as n_envs; [-1]: this one"
    )
    observation_topic: Literal["observation", "observation_seen"] = Field(
        "observation", description="what the policies act on"
    )


def read_parameters(node: Node) -> TrainerParameters:
    """Declares the parameters on ``node`` and returns what was set on the command line.

    Raises:
        UserError: an unknown name, a wrong type, a value out of range, or no config or out.
    """
    parameters = read_model(node, TrainerParameters)
    require(node, parameters, "config", "out")
    if len(set(parameters.domains)) != len(parameters.domains):
        raise UserError(f"parameter domains = {parameters.domains}: a domain comes twice")
    return parameters
