"""The learner's loss, slow and plain, in float64: one episode, one step, one robot at a time.

It shares no code with the product. Gradients come from autograd over these scalar loops. The
parameters have the product's names; the state layer holds, one under the other, the first layers
of W1, W2 and V, and the layer b1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from policy_pkg.episode import Episode, Sizes

Params = dict[str, Tensor]


@dataclass(frozen=True)
class Reference:
    """What the loss depends on beside parameters and data."""

    algorithm: str
    gamma: float = 0.99
    double_q: bool = True
    drop_crashed: bool = False
    crashed_target: str = "max"
    td_lambda: float = 0.0


def random_episode(
    sizes: Sizes, rng: np.random.Generator, steps: int, terminated: bool, crash_rate: float = 0.0
) -> Episode:
    """Random content; every available-action row holds action 0, taken actions are available."""
    n, actions = sizes.n_robots, sizes.n_actions
    available = rng.random((steps + 1, n, actions)) < 0.5
    available[..., 0] = True
    preference = np.where(available, rng.random(available.shape), -1.0)
    crashed = np.broadcast_to(rng.random(n) < crash_rate, (steps, n))
    return Episode(
        obs=rng.standard_normal((steps + 1, n, sizes.obs_size), dtype=np.float32),
        state=rng.standard_normal((steps + 1, sizes.state_size), dtype=np.float32),
        available=available,
        actions=preference[:-1].argmax(2).astype(np.int32),
        reward=rng.standard_normal(steps, dtype=np.float32),
        faults=crashed.astype(np.uint8),
        terminated=terminated,
    )


def _one_hot(index: int, size: int) -> Tensor:
    vector = torch.zeros(size, dtype=torch.float64)
    if index >= 0:
        vector[index] = 1.0
    return vector


def agent_step(params: Params, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
    """One robot, one time step: (input, hidden) -> (action values, new hidden)."""
    size = hidden.shape[0]
    embedded = torch.clamp(params["agent.fc1.weight"] @ x + params["agent.fc1.bias"], min=0.0)
    gates_x = params["agent.rnn.weight_ih"] @ embedded + params["agent.rnn.bias_ih"]
    gates_h = params["agent.rnn.weight_hh"] @ hidden + params["agent.rnn.bias_hh"]
    reset = 1.0 / (1.0 + torch.exp(-(gates_x[:size] + gates_h[:size])))
    update = 1.0 / (1.0 + torch.exp(-(gates_x[size : 2 * size] + gates_h[size : 2 * size])))
    new = torch.tanh(gates_x[2 * size :] + reset * gates_h[2 * size :])
    hidden = (1.0 - update) * new + update * hidden
    return params["agent.fc2.weight"] @ hidden + params["agent.fc2.bias"], hidden


def values(params: Params, episode: Episode) -> list[list[Tensor]]:
    """Action values by [time][robot], for times 0 to T."""
    steps, n = episode.actions.shape
    n_actions = episode.available.shape[2]
    size = params["agent.rnn.weight_hh"].shape[1]
    out: list[list[Tensor]] = [[] for _ in range(steps + 1)]
    for robot in range(n):
        hidden = torch.zeros(size, dtype=torch.float64)
        for t in range(steps + 1):
            last = int(episode.actions[t - 1, robot]) if t > 0 else -1
            obs = torch.tensor(episode.obs[t, robot].astype(np.float64))
            x = torch.cat((obs, _one_hot(last, n_actions), _one_hot(robot, n)))
            q, hidden = agent_step(params, x, hidden)
            out[t].append(q)
    return out


def mix(algorithm: str, params: Params, q: list[Tensor], state: np.ndarray) -> Tensor:
    """Q_tot of one step from the robots' scalar values."""
    if algorithm == "vdn":
        total = torch.zeros((), dtype=torch.float64)
        for value in q:
            total = total + value
        return total
    s = torch.tensor(state.astype(np.float64))
    mixing, hyper = params["mixer.w2.weight"].shape
    first = params["mixer.state.weight"] @ s + params["mixer.state.bias"]
    w1_in = torch.clamp(first[:hyper], min=0.0)
    w2_in = torch.clamp(first[hyper : 2 * hyper], min=0.0)
    v_in = torch.clamp(first[2 * hyper : 2 * hyper + mixing], min=0.0)
    inner = first[2 * hyper + mixing :]
    w1 = torch.abs(params["mixer.w1.weight"] @ w1_in + params["mixer.w1.bias"])
    w2 = torch.abs(params["mixer.w2.weight"] @ w2_in + params["mixer.w2.bias"])
    for robot, value in enumerate(q):
        inner = inner + value * w1[robot * mixing : (robot + 1) * mixing]
    elu = torch.where(inner > 0, inner, torch.exp(torch.clamp(inner, max=0.0)) - 1.0)
    v = params["mixer.v.weight"][0] @ v_in + params["mixer.v.bias"][0]
    return elu @ w2 + v


def _next_value(
    ref: Reference,
    sizes: Sizes,
    available: np.ndarray,
    online: Tensor,
    target: Tensor,
    crashed: bool,
) -> Tensor:
    allowed = [a for a in range(sizes.n_actions) if available[a]]
    if crashed and ref.crashed_target == "mean":
        return torch.stack([target[a] for a in allowed]).mean()
    if crashed and ref.crashed_target == "stay":
        return target[next(a for a in sizes.stay_actions if available[a])]
    chooser = online if ref.double_q else target
    return target[max(allowed, key=lambda a: chooser[a].item())]


def loss(
    ref: Reference, sizes: Sizes, online: Params, target: Params, episodes: list[Episode]
) -> Tensor:
    """Mean squared TD error over the steps t < T of the episodes (iql: over steps and robots)."""
    errors: list[Tensor] = []
    for episode in episodes:
        q_online, q_target = values(online, episode), values(target, episode)
        later: list[Tensor] = []  # the next step's returns: of the team, for iql of each robot
        for t in reversed(range(episode.length)):
            taken, following = [], []
            for robot in range(sizes.n_robots):
                taken.append(q_online[t][robot][int(episode.actions[t, robot])])
                next_value = _next_value(
                    ref,
                    sizes,
                    episode.available[t + 1, robot],
                    q_online[t + 1][robot],
                    q_target[t + 1][robot],
                    bool(episode.faults[t, robot]),
                )
                following.append(next_value.detach())
            ended = episode.terminated and t == episode.length - 1
            discount = 0.0 if ended else ref.gamma
            reward = float(episode.reward[t])
            if ref.algorithm != "iql":
                following = [mix(ref.algorithm, target, following, episode.state[t + 1]).detach()]
                taken = [mix(ref.algorithm, online, taken, episode.state[t])]
            if later:
                following = [
                    (1 - ref.td_lambda) * value + ref.td_lambda * ahead
                    for value, ahead in zip(following, later, strict=True)
                ]
            later = [reward + discount * value for value in following]
            for robot, (target_value, value) in enumerate(zip(later, taken, strict=True)):
                if not (ref.drop_crashed and episode.faults[t, robot]):
                    errors.append(target_value - value)
    return torch.stack([error * error for error in errors]).mean()


def params_of(arrays: dict[str, np.ndarray], net: str, gradient: bool) -> Params:
    """A net's parameters out of a learner's state, as float64 tensors of their own."""
    prefix = f"{net}."
    return {
        name.removeprefix(prefix): torch.tensor(
            np.asarray(array, dtype=np.float64), requires_grad=gradient
        )
        for name, array in arrays.items()
        if name.startswith(prefix)
    }
