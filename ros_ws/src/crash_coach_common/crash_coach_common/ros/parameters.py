"""A node's parameters: served, and declared from a strict model that validates them.

rclpy's own services let a type through that does not exist, which ends the node, make a parameter
without a name, and do not say which name is not declared. Here all three are refused by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
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


def _choices_of(about: FieldInfo) -> tuple[str, ...]:
    """The words that an enumerated field takes; empty for any other field."""
    literal = get_origin(about.annotation) is Literal
    return tuple(str(word) for word in get_args(about.annotation)) if literal else ()


def choices_text(choices: Iterable[str]) -> str:
    """A descriptor's additional constraints."""
    listed = ", ".join(choices)
    return f"one of: {listed}" if listed else ""


def declare_model(node: Node, model: type[Model]) -> Model:
    """Declares every field of ``model`` on ``node``, read-only; returns what was set at the start.

    Raises:
        ConfigError: a wrong type, or a value out of range.
    """
    values = {}
    for name, about in model.model_fields.items():
        # Typed by the model, which says more than a type mismatch in rclpy does.
        descriptor = ParameterDescriptor(
            description=about.description,
            additional_constraints=choices_text(_choices_of(about)),
            read_only=True,
            dynamic_typing=True,
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
    """For a node made with ``start_parameter_services=False``.

    Several parameters in one call of set_parameters, such as `ros2 param load` makes, are set
    together where that is possible, so that their order does not matter; otherwise one by one, each
    with its own result. What is read-only is left as it is, and does not keep the others from it.

    said: what came of the last change, empty: nothing to tell; it becomes the result's reason,
    which rclpy leaves empty where a change succeeds. `ros2 param set` prints it.
    """

    def __init__(self, node: Node, said: Callable[[], str] = str) -> None:
        super().__init__(node)
        self._said = said

    def _set_parameters_callback(
        self, request: SetParameters.Request, response: SetParameters.Response
    ) -> SetParameters.Response:
        wanted = [p for p in request.parameters if not self._read_only(p.name)]
        together = len(wanted) > 1 and self._refusal(wanted) is None and self._set_together(wanted)
        for parameter in request.parameters:
            refusal = self._refusal([parameter])
            if refusal is not None:
                response.results.append(refusal)
            elif together and not self._read_only(parameter.name):
                response.results.append(self._with_words(SetParametersResult(successful=True)))
            else:
                one = SetParameters.Request(parameters=[parameter])
                super()._set_parameters_callback(one, response)
                self._with_words(response.results[-1])
        return response

    def _with_words(self, result: SetParametersResult) -> SetParametersResult:
        if result.successful:
            result.reason = self._said()
        return result

    def _set_together(self, parameters: list[ParameterMessage]) -> bool:
        """Whether all could be set at once; otherwise nothing was."""
        request = SetParametersAtomically.Request(parameters=parameters)
        response = SetParametersAtomically.Response()
        super()._set_parameters_atomically_callback(request, response)
        return bool(response.result.successful)

    def _read_only(self, name: str) -> bool:
        node = self._get_node()
        return node.has_parameter(name) and bool(node.describe_parameter(name).read_only)

    def _set_parameters_atomically_callback(
        self,
        request: SetParametersAtomically.Request,
        response: SetParametersAtomically.Response,
    ) -> SetParametersAtomically.Response:
        refusal = self._refusal(request.parameters)
        if refusal is None:
            super()._set_parameters_atomically_callback(request, response)
            self._with_words(response.result)
        else:
            response.result = refusal
        return response

    def _refusal(self, parameters: Iterable[ParameterMessage]) -> SetParametersResult | None:
        node = self._get_node()
        for parameter in parameters:
            reason, name = "", parameter.name
            if not name:
                reason = "a parameter has no name"
            elif parameter.value.type > LAST_TYPE:
                reason = f"parameter {name}: {parameter.value.type} is no parameter type"
            elif not node.has_parameter(name):
                near = did_you_mean(name, sorted(node._parameters))
                reason = f"{node.get_name()} has no parameter {name!r}{near}"
            if reason:
                return SetParametersResult(successful=False, reason=reason)
        return None
