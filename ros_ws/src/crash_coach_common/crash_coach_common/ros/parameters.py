"""A node's parameters: served, and declared from a strict model that validates them.

rclpy's own services let a type through that does not exist, which ends the node, and make a
parameter without a name. Here both are refused.
"""

from __future__ import annotations

from collections.abc import Container, Iterable
from typing import TypeVar

from pydantic import BaseModel, ValidationError
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterDescriptor, ParameterType, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.node import Node
from rclpy.parameter_service import ParameterService

from crash_coach_common.strict_yaml import ConfigError

LAST_TYPE = ParameterType.PARAMETER_STRING_ARRAY
_OF_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides")

Model = TypeVar("Model", bound=BaseModel)


def unknown_parameter(node: Node, known: Container[str]) -> str | None:
    """The first parameter that was set at the start and is neither ``known`` nor rclpy's own."""
    names = node._parameter_overrides
    return next((n for n in names if n not in known and n.split(".")[0] not in _OF_RCLPY), None)


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
