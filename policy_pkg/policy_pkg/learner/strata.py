"""What a replay draws evenly over; apart, so that a config needs no compiled code."""

from __future__ import annotations

from typing import Literal

Strata = Literal["none", "crashed", "outcome"]
Weights = Literal["none", "importance"]
