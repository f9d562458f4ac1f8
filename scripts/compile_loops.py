"""Compiles the simulator's functions, which are kept beside their sources; `make setup` runs it.

The first episode of each kind of scenario would else begin some 10 s late, and in each of the
processes that play it at the time.
"""

from __future__ import annotations

import numpy as np

from sim_pkg.env import make_env, scenario_names
from sim_pkg.scripted import make_scripted, scripted_names


def main() -> None:
    """A step of every scripted policy on every scenario that comes with the simulator."""
    first = np.zeros(1, dtype=np.intp)
    for scenario in scenario_names():
        env = make_env(scenario, 1)
        for name in scripted_names(env):
            team = make_scripted(name, env)
            env.reset(first, 0, first)
            team.begin(first, 0, first)
            actions = np.zeros((1, env.spec.n_robots), dtype=np.int32)
            team.act(env.obs, env.available, actions)
            env.step(actions)


if __name__ == "__main__":
    main()
