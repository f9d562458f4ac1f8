"""Crashes robots of a running graph through the coach's parameters, as ``ros2 param set`` does."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import Trigger

from crash_coach_bringup.ros.client import GraphClient, graph_client
from crash_coach_bringup.ros.namespaces import checked_namespace
from crash_coach_common.contract import UserError
from crash_coach_pkg.coach.injection import describe, injection
from crash_coach_pkg.faults import check_parameters

COACH = "coach"


class InjectError(UserError):
    """Nothing was changed; the text is the reason."""


@dataclass(frozen=True)
class InjectResult:
    """What the coach accepted."""

    victims: tuple[str, ...]
    mode: str
    apply_at: str
    start_step: int
    duration_steps: int
    parameters: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return describe(self.victims, self.mode, self.apply_at, self.parameters)


def inject(
    victims: Sequence[str],
    mode: str,
    apply_at: str = "next_step",
    duration_steps: int = 0,
    start_step: int = 0,
    timeout_s: float = 10.0,
    domain: int | None = None,
    parameters: Mapping[str, float] | None = None,
    namespace: str = "",
) -> InjectResult:
    """Makes ``victims`` crash, all or none; returns once the gate has armed the fault.

    Args:
        victims: names of robots.
        mode: a mode of crash_coach_pkg.faults.
        apply_at: next_step or next_episode.
        duration_steps: control steps; 0: until the episode ends.
        start_step: first faulted step of each episode, for next_episode.
        timeout_s: longest wait for the coach to appear, and again for its answer.
        domain: ROS domain; None: the environment's.
        parameters: of the mode; what is missing has its default.
        namespace: that the graph was started in.

    Raises:
        InjectError: the coach refused, with its reason.
        UserError: no victims, unknown mode, or parameters that it does not have.
        WaitError: no coach on this domain, or no answer.
    """
    given = parameters or {}
    wanted = injection(victims, mode, apply_at, start_step, duration_steps, given)
    settings = [
        Parameter(name, value=list(value) if isinstance(value, tuple) else value)
        for name, value in wanted.items()
    ]
    no_coach = _no_coach(domain, namespace)
    with graph_client("crash_coach_inject", domain, namespace=namespace) as client:
        setter = AsyncParameterClient(client.node, COACH)
        client.greet(COACH, timeout_s, no_coach)
        client.until(setter.services_are_ready, timeout_s, no_coach)
        future = setter.set_parameters_atomically(settings)
        result = client.result(future, timeout_s, "the coach's answer").result
    if not result.successful:
        raise InjectError(f"the coach refused: {result.reason}")
    known = check_parameters(mode, given).model_dump()
    return InjectResult(tuple(victims), mode, apply_at, start_step, duration_steps, known)


def clear(timeout_s: float = 10.0, domain: int | None = None, namespace: str = "") -> str:
    """Ends every fault, from the next step on; returns the coach's answer.

    Raises:
        InjectError: the coach refused, with its reason.
        WaitError: no coach on this domain, or no answer.
    """
    with graph_client("crash_coach_clear", domain, namespace=namespace) as client:
        return _clear(client, timeout_s, _no_coach(domain, namespace))


def _clear(client: GraphClient, timeout_s: float, no_coach: str) -> str:
    service = client.node.create_client(Trigger, f"{COACH}/clear_all")
    client.greet(COACH, timeout_s, no_coach)
    client.until(service.service_is_ready, timeout_s, no_coach)
    future = service.call_async(Trigger.Request())
    answer = client.result(future, timeout_s, "the coach's answer")
    if not answer.success:
        raise InjectError(f"the coach refused: {answer.message}")
    return str(answer.message)


def _no_coach(domain: int | None, namespace: str) -> str:
    shown = os.environ.get("ROS_DOMAIN_ID", "0") if domain is None else domain
    name = f"{checked_namespace(namespace)}/{COACH}"
    start = "start one with 'crash-coach up' or 'crash-coach gate'"
    return f"a node {name} on ROS domain {shown}; {start}"
