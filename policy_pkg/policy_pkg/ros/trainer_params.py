"""The trainer's parameters: one strict model, declared from it and validated by it."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from sim_pkg.contract import UserError

_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides")
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
    known = TrainerParameters.model_fields
    for name in node._parameter_overrides:
        if name not in known and name.split(".")[0] not in _OF_RCLPY:
            raise UserError(f"unknown parameter {name!r} of trainer; known: {', '.join(known)}")
    values = {}
    for name, about in known.items():
        # Typed by the model, which says more than a type mismatch in rclpy does.
        descriptor = ParameterDescriptor(
            description=about.description, read_only=True, dynamic_typing=True
        )
        value = node.declare_parameter(name, about.default, descriptor).value
        values[name] = value if isinstance(value, str | int | float) else list(value)
    try:
        parameters = TrainerParameters.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        name = ".".join(map(str, problem["loc"]))
        raise UserError(f"parameter {name} = {problem['input']!r}: {problem['msg']}") from error
    for name in ("config", "out"):
        if not getattr(parameters, name):
            raise UserError(f"parameter {name!r} of trainer is missing: {known[name].description}")
    if len(set(parameters.domains)) != len(parameters.domains):
        raise UserError(f"parameter domains = {parameters.domains}: a domain comes twice")
    return parameters
