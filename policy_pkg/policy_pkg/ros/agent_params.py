"""The policy nodes' parameters."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.parameters import read_model, require
from policy_pkg.team_name import scripted_name

_WITHOUT_LIVE = ("checkpoint", "epsilon", "exploration_seed")


class TeamParameters(BaseModel):
    """Of executable ``team``. Read once at start-up."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    checkpoint: str = Field(
        "", description="run directory, RUN@best, checkpoint or scripted:NAME; see live"
    )
    scenario: str = Field("", description="of a scripted team, which does not know its own")
    live: bool = Field(False, description="act on the weights of a trainer instead of a checkpoint")
    command_topic: str = Field(
        "command_raw", min_length=1, description="answers go to /<robot>/<this>"
    )
    observation_topic: str = Field(
        "observation",
        min_length=1,
        description="acts on /<robot>/<this>; observation_seen where the gate relays observations",
    )
    lockstep: bool = Field(
        False,
        description="the sim is in lock-step and asks again for what is lost: nothing is "
        "acknowledged, which is faster",
    )
    epsilon: float = Field(
        0.0,
        ge=0,
        le=1,
        allow_inf_nan=False,
        description="probability, per robot and step, of a uniform available action instead of "
        "the best one; 1: a random team",
    )
    exploration_seed: int = Field(
        0,
        ge=0,
        le=2**63 - 1,
        description="keys these with (episode, step, robot), and what a scripted team draws",
    )


class PolicyParameters(TeamParameters):
    """Of executable ``policy``."""

    robot: str = Field("", description="robot that this policy drives")


def read_parameters(node: Node, model: type[TeamParameters]) -> TeamParameters:
    """Raises UserError: as ``read_model``, something is missing, or has no meaning with live."""
    parameters = read_model(node, model)
    if not parameters.live:
        require(node, parameters, "checkpoint")
        if scripted_name(parameters.checkpoint) is not None:
            require(node, parameters, "scenario")
    for name in _WITHOUT_LIVE if parameters.live else ():
        if getattr(parameters, name) != model.model_fields[name].default:
            raise UserError(f"parameter {name!r} of {node.get_name()} has no meaning with live")
    if model is PolicyParameters:
        require(node, parameters, "robot")
    return parameters
