"""Compiled: the parts of a control step before, between and after the advances of the physics.

Each is one call, because a call from Python with so many arrays costs about 1 us, as much as its
work on one arena. Shapes and columns as in tables.py.
"""

from __future__ import annotations

from sim_pkg.compiled import entry
from sim_pkg.scenarios.skirmish.brake import brake
from sim_pkg.scenarios.skirmish.combat import fight
from sim_pkg.scenarios.skirmish.observe import observe, score
from sim_pkg.scenarios.skirmish.orders import drive, take_orders


@entry
def move(  # type: ignore[no-untyped-def]
    first, running, actions, n, bodies, units, reach, real, whole, hits,
    ticks, tick_s, hits_s, damage, extras_s, clock_s,
    phase_s, acquire, leash, habits, goal, free, commands,
):  # fmt: skip
    """The velocities of a phase: of the ``first`` after the robots' actions became orders, of the
    others after the fight of the phase before. Whether any died in that."""
    deaths = False
    if first:
        hits[:] = 0.0
        take_orders(running, actions, bodies, real, whole)
    else:
        deaths = fight(
            running, ticks, tick_s, bodies, units, hits_s, damage, reach, extras_s, clock_s, real,
            whole, hits,
        )  # fmt: skip
    drive(
        running, n, phase_s, bodies, units, reach, acquire, leash, habits, goal, real, whole,
        commands,
    )  # fmt: skip
    brake(running, phase_s, bodies, units, free, whole, commands)
    return deaths


@entry
def end(  # type: ignore[no-untyped-def]
    running, n, bodies, units, reach, real, whole, hits,
    ticks, tick_s, hits_s, damage, extras_s, clock_s,
    limit, full, steps, standing, reward, terminated, success,
    shields, types, free, arena_m, obs, state, available,
):  # fmt: skip
    """The fight of the last phase, the step's outcome and what is seen. Whether any died."""
    deaths = fight(
        running, ticks, tick_s, bodies, units, hits_s, damage, reach, extras_s, clock_s, real,
        whole, hits,
    )  # fmt: skip
    score(running, n, limit, full, real, whole, steps, standing, reward, terminated, success)
    observe(
        running, n, bodies, units, real, whole, clock_s, shields, types, free, arena_m, obs, state,
        available,
    )  # fmt: skip
    return deaths
