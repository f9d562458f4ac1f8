"""Scripted policies by name; see base.py."""

from sim_pkg.scripted.base import ScriptedPolicy, make_scripted, scripted_names

__all__ = ["ScriptedPolicy", "make_scripted", "scripted_names"]
