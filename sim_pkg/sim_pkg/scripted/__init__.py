"""Scripted policies by name; see base.py."""

from sim_pkg.scripted import coverage, skirmish, transport
from sim_pkg.scripted.base import (
    REGISTRY,
    ConfiguredEnv,
    ScriptedPolicy,
    make_scripted,
    scripted_names,
)

__all__ = ["ConfiguredEnv", "ScriptedPolicy", "make_scripted", "scripted_names"]

REGISTRY.update(coverage.ENTRIES | skirmish.ENTRIES | transport.ENTRIES)
