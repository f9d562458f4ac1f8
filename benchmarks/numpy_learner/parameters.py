"""Parameters of a learner in one flat vector, seen through named views.

Optimiser, gradient norm and target copy each work on the whole vector at once: with a dozen
small tensors, the calls would cost more than the arithmetic.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Shapes = dict[str, tuple[int, ...]]


def linear(name: str, fan_in: int, fan_out: int) -> Shapes:
    """Weight (out, in) and bias (out,) of a linear layer."""
    return {f"{name}.weight": (fan_out, fan_in), f"{name}.bias": (fan_out,)}


def initial_values(
    shapes: Shapes, fan_in: dict[str, int], rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    """Uniform in +-1/sqrt(fan in), torch's default for nn.Linear and nn.GRUCell; flat.

    ``fan_in`` is keyed by the layer, a parameter's name without its last part.
    """
    parts = []
    for name, shape in shapes.items():
        bound = 1.0 / np.sqrt(fan_in[name.rpartition(".")[0]])
        parts.append(rng.uniform(-bound, bound, prod(shape)))
    return np.concatenate(parts)


class FlatParameters:
    """Named parameters over one flat vector, and their gradients likewise; all views."""

    def __init__(self, shapes: Shapes, values: Array, dtype: npt.DTypeLike) -> None:
        self.flat: Array = values.astype(dtype)
        self.gradient = np.zeros_like(self.flat)
        self.named = self._views(self.flat, shapes)
        self.named_gradients = self._views(self.gradient, shapes)

    @staticmethod
    def _views(flat: Array, shapes: Shapes) -> dict[str, Array]:
        parts = np.split(flat, np.cumsum([prod(shape) for shape in shapes.values()])[:-1])
        return {
            name: part.reshape(shape)
            for part, (name, shape) in zip(parts, shapes.items(), strict=True)
        }


def part(named: dict[str, Array], prefix: str) -> dict[str, Array]:
    """Those whose names start with ``prefix``, without it."""
    return {k.removeprefix(prefix): v for k, v in named.items() if k.startswith(prefix)}
