"""A node's parameters as one strict model: declared from it and validated by it."""

from __future__ import annotations

from typing import TypeVar

from pydantic import BaseModel, ValidationError
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node

from sim_pkg.contract import UserError
from sim_pkg.ros.parameter_service import CheckedParameterService

_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides")

Model = TypeVar("Model", bound=BaseModel)


def read_model(node: Node, model: type[Model]) -> Model:
    """Declares every field of ``model`` on ``node``, read-only; returns what was set at the start.

    ``node`` is made without rclpy's parameter services: it gets checked ones here.

    Raises:
        UserError: an unknown name, a wrong type, a value out of range.
    """
    CheckedParameterService(node)
    known = model.model_fields
    for name in node._parameter_overrides:
        if name not in known and name.split(".")[0] not in _OF_RCLPY:
            raise UserError(
                f"unknown parameter {name!r} of {node.get_name()}; known: {', '.join(known)}"
            )
    values = {}
    for name, about in known.items():
        # Typed by the model, which says more than a type mismatch in rclpy does.
        descriptor = ParameterDescriptor(
            description=about.description, read_only=True, dynamic_typing=True
        )
        value = node.declare_parameter(name, about.default, descriptor).value
        scalar = value is None or isinstance(value, str | int | float)
        values[name] = value if scalar else list(value)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        name = ".".join(map(str, problem["loc"]))
        raise UserError(f"parameter {name} = {problem['input']!r}: {problem['msg']}") from error


def require(node: Node, parameters: BaseModel, *names: str) -> None:
    """Raises UserError for the first of ``names`` that was left empty."""
    for name in names:
        if getattr(parameters, name) in ("", [""]):
            about = type(parameters).model_fields[name].description
            raise UserError(f"parameter {name!r} of {node.get_name()} is missing: {about}")
