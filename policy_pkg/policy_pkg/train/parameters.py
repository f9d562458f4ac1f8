"""Parameters of a learner in one flat vector, seen through named views.

Optimiser, gradient norm and target copy each work on the whole vector at once: with a dozen
small tensors, the calls would cost more than the arithmetic.
"""

from __future__ import annotations

from math import prod
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

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
    """Named tensors over one flat vector, both leaves of autograd.

    ``gradient`` is the flat gradient; ``flat.grad`` and the named tensors' gradients are views.
    """

    def __init__(self, shapes: Shapes, values: npt.NDArray[np.float64], dtype: torch.dtype) -> None:
        self.flat = torch.from_numpy(values).to(dtype, copy=True)
        self.gradient = torch.zeros_like(self.flat)
        self.named = self._views(self.flat.detach(), shapes)
        for name, view in self._views(self.gradient, shapes).items():
            self.named[name].requires_grad_().grad = view
        self.flat.requires_grad_().grad = self.gradient

    @staticmethod
    def _views(flat: Tensor, shapes: Shapes) -> dict[str, Tensor]:
        parts = flat.split_with_sizes([prod(shape) for shape in shapes.values()])
        return {name: part.view(shapes[name]) for name, part in zip(shapes, parts, strict=True)}

    def arrays(self, prefix: str = "") -> dict[str, npt.NDArray[Any]]:
        """The named values whose names start with ``prefix``, which is cut off; no copy."""
        return {
            name.removeprefix(prefix): tensor.detach().numpy()
            for name, tensor in self.named.items()
            if name.startswith(prefix)
        }
