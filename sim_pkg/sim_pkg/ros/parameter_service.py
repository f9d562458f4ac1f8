"""rclpy's parameter services, and what they let through: a type that does not exist ends the node,
and a parameter without a name is made. Here both are refused.

Other packages' nodes may import this: it is written once.
"""

from __future__ import annotations

from collections.abc import Iterable

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterType, SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter_service import ParameterService

LAST_TYPE = ParameterType.PARAMETER_STRING_ARRAY


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
