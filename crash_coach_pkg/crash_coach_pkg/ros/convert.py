"""Messages to and from the core's types."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from crash_coach_interfaces.msg import Action, FaultEvent
from crash_coach_interfaces.msg import CrashPlan as CrashPlanMessage
from crash_coach_interfaces.msg import Fault as FaultMessage
from std_msgs.msg import Header

from crash_coach_pkg.gate_state import Command, Decision, Event
from crash_coach_pkg.plan import CrashPlan, Fault, Mode, parse_mode

MODE_TEXT = {Mode.NONE: "", Mode.MUTE: "mute", Mode.RANDOM: "random"}


def message_from_plan(
    plan: CrashPlan, robots: tuple[str, ...], lease_s: float, stamp: Time
) -> CrashPlanMessage:
    return CrashPlanMessage(
        header=Header(stamp=stamp),
        episode=plan.episode,
        revision=plan.revision,
        seed=plan.seed,
        rate=plan.rate,
        cap=plan.cap,
        lease_s=lease_s,
        faults=[
            FaultMessage(
                robot=robots[fault.robot],
                mode=MODE_TEXT[fault.mode],
                start_step=fault.start_step,
                duration_steps=fault.duration_steps,
            )
            for fault in plan.faults
        ],
    )


def plan_from_message(message: CrashPlanMessage, robots: tuple[str, ...]) -> CrashPlan:
    """Raises ValueError for an unknown robot or mode, or a lease that is not positive."""
    if not message.lease_s > 0:
        raise ValueError(f"lease_s {message.lease_s} is not positive")
    faults = []
    for fault in message.faults:
        if fault.robot not in robots:
            raise ValueError(f"unknown robot {fault.robot!r}; one of: {', '.join(robots)}")
        mode = parse_mode(fault.mode)
        faults.append(
            Fault(robots.index(fault.robot), mode, fault.start_step, fault.duration_steps)
        )
    return CrashPlan(
        message.episode, message.revision, message.seed, message.rate, message.cap, tuple(faults)
    )


def command_from_message(robot: int, message: Action) -> Command:
    """The message itself is the token."""
    return Command(robot, message.episode, message.step, message.action, message)


def message_from_decision(decision: Decision) -> Action:
    """What goes out on /<robot>/command: the message that came in, where it was not replaced."""
    raw = decision.command.token
    if decision.mode == Mode.NONE:
        raw.fault = Action.FAULT_NONE
        return raw
    return Action(
        header=raw.header,
        episode=raw.episode,
        step=raw.step,
        action=decision.applied,
        fault=int(decision.mode),
    )


def effect_from_decision(decision: Decision, robots: tuple[str, ...]) -> FaultEvent:
    command = decision.command
    return FaultEvent(
        header=command.token.header,
        kind=FaultEvent.EFFECT,
        episode=command.episode,
        step=command.step,
        revision=decision.revision,
        robot=robots[command.robot],
        mode=MODE_TEXT[decision.mode],
        intent=command.action,
        applied=decision.applied,
    )


def message_from_event(event: Event, stamp: Time) -> FaultEvent:
    return FaultEvent(
        header=Header(stamp=stamp),
        kind=int(event.kind),
        episode=event.episode,
        step=event.step,
        revision=event.revision,
        intent=-1,
        applied=-1,
    )
