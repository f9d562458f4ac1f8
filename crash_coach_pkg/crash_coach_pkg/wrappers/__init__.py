"""The coach around anybody's environment; needs numpy, pydantic and PettingZoo, nothing else."""

from crash_coach_pkg.wrappers.crash_wrapper import CrashWrapper
from crash_coach_pkg.wrappers.multi_agent_view import MultiAgentView

__all__ = ["CrashWrapper", "MultiAgentView"]
