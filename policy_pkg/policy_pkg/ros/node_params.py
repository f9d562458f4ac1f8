"""A node's parameters as one strict model: declared from it and validated by it."""

from __future__ import annotations

from pydantic import BaseModel
from rclpy.node import Node

from crash_coach_common.contract import UserError
from crash_coach_common.ros.parameters import (
    CheckedParameterService,
    Model,
    declare_model,
    unknown_parameter,
)


def read_model(node: Node, model: type[Model]) -> Model:
    """Declares every field of ``model`` on ``node``, read-only; returns what was set at the start.

    ``node`` is made without rclpy's parameter services: it gets checked ones here.

    Raises:
        UserError: an unknown name, a wrong type, a value out of range.
    """
    CheckedParameterService(node)
    known = model.model_fields
    name = unknown_parameter(node, known)
    if name is not None:
        raise UserError(
            f"unknown parameter {name!r} of {node.get_name()}; known: {', '.join(known)}"
        )
    return declare_model(node, model)


def require(node: Node, parameters: BaseModel, *names: str) -> None:
    """Raises UserError for the first of ``names`` that was left empty."""
    for name in names:
        if getattr(parameters, name) in ("", [""]):
            about = type(parameters).model_fields[name].description
            raise UserError(f"parameter {name!r} of {node.get_name()} is missing: {about}")
