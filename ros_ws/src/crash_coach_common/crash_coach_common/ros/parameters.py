"""A node's parameters: served, and declared from a strict model that validates them.

rclpy's own services let a type through that does not exist, which ends the node, and make a
parameter without a name. Here both are refused.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

from pydantic import BaseModel, ValidationError
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter_service import ParameterService

from crash_coach_common.contract import UserError
from crash_coach_common.strict_yaml import ConfigError, did_you_mean

LAST_TYPE = ParameterType.PARAMETER_STRING_ARRAY
_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides")

Model = TypeVar("Model", bound=BaseModel)


def refuse_unknown(node: Node, known: Iterable[str]) -> None:
    """Raises UserError for a parameter set at the start, neither ``known`` nor rclpy's own."""
    names = tuple(known)
    for name in node._parameter_overrides:
        if name not in names and name.split(".")[0] not in _OF_RCLPY:
            raise UserError(
                f"unknown parameter {name!r}{did_you_mean(name, names)} of {node.get_name()}; "
                f"known: {', '.join(names)}"
            )


def refuse_undeclared(node: Node) -> None:
    """As ``refuse_unknown``, when the node has declared all that it knows."""
    refuse_unknown(node, sorted(node._parameters))


def declare_model(node: Node, model: type[Model]) -> Model:
    """Declares every field of ``model`` on ``node``, read-only; returns what was set at the start.

    Raises:
        ConfigError: a wrong type, or a value out of range.
    """
    values = {}
    for name, about in model.model_fields.items():
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
        raise ConfigError(f"parameter {name} = {problem['input']!r}: {problem['msg']}") from error


def read_model(node: Node, model: type[Model]) -> Model:
    """Declares every field of ``model`` on ``node``, read-only; returns what was set at the start.

    ``node`` is made without rclpy's parameter services: it gets checked ones here.

    Raises:
        UserError: an unknown name, a wrong type, a value out of range.
    """
    CheckedParameterService(node)
    refuse_unknown(node, model.model_fields)
    return declare_model(node, model)


def require(node: Node, parameters: BaseModel, *names: str) -> None:
    """Raises UserError for the first of ``names`` that was left empty."""
    for name in names:
        if getattr(parameters, name) in ("", [""]):
            about = type(parameters).model_fields[name].description
            raise UserError(f"parameter {name!r} of {node.get_name()} is missing: {about}")


class CheckedParameterService(ParameterService):
    """For a node made with ``start_parameter_services=False``."""

    def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        for parameter in request.parameters:
            refusal = _refusal([parameter])
            if refusal is None:
                one = SetParameters.Request(parameters=[parameter])
                super()._set_parameters_callback(one, response)
            else:
                response.results.append(refusal)
        return response

    def _set_parameters_atomically_callback(
        self,
        request: SetParametersAtomically.Request,
        response: SetParametersAtomically.Response,
    ) -> SetParametersAtomically.Response:
        refusal = _refusal(request.parameters)
        if refusal is None:
            return super()._set_parameters_atomically_callback(request, response)
        response.result = refusal
        return response


def _refusal(parameters: Iterable[ParameterMessage]) -> SetParametersResult | None:
    for parameter in parameters:
        reason = ""
        if not parameter.name:
            reason = "a parameter has no name"
        elif parameter.value.type > LAST_TYPE:
            reason = f"parameter {parameter.name}: {parameter.value.type} is no parameter type"
        if reason:
            return SetParametersResult(successful=False, reason=reason)
    return None
