"""`crash-coach doctor`: what this machine has, what is missing, how to mend it."""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import shutil
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import typer

from crash_coach_bringup.cli.output import check_json_target, console, table, written_first
from crash_coach_bringup.ros.shared_memory import SHARED_MEMORY, half_made
from crash_coach_common.caches import places
from crash_coach_common.contract import UserError
from policy_pkg import native
from policy_pkg.kernels import SAME_EVERYWHERE, kernels

LIBRARIES = ("numpy", "numba", "pymunk", "torch", "safetensors", "pydantic", "matplotlib")
FREE_BYTES = 10**9


@dataclass(frozen=True)
class Finding:
    check: str
    ok: bool
    found: str
    hint: str = ""


def python_version() -> Finding:
    version = ".".join(map(str, sys.version_info[:3]))
    ok = (3, 11) <= sys.version_info[:2] <= (3, 14)
    return Finding("Python", ok, version, "" if ok else "3.11 to 3.14 is needed")


def compiler() -> Finding:
    path = shutil.which("c++")
    hint = "only needed to build the messages: apt-get install build-essential"
    return Finding("C++ compiler", path is not None, path or "none", "" if path else hint)


def disk() -> Finding:
    free = shutil.disk_usage(".").free
    ok = free > FREE_BYTES
    return Finding("free disk", ok, f"{free / 1e9:.1f} GB", "" if ok else "runs need about 1 GB")


def threads() -> Finding:
    value = os.environ.get("OMP_NUM_THREADS", "unset")
    hint = "" if value == "1" else "source env.sh: a second thread slows training down"
    return Finding("threads per process", value == "1", value, hint)


def blas_kernels() -> Finding:
    found, (variable, wanted) = kernels()["openblas"], SAME_EVERYWHERE["numpy"]
    hint = (
        ""
        if found == wanted
        else (
            f"runs are the same on every machine with {variable}={wanted}: source env.sh "
            "(needs AVX2)"
        )
    )
    return Finding("BLAS kernels", found == wanted, found or "not OpenBLAS", hint)


def compiled_kernels() -> Finding:
    check, asked = "compiled kernels", os.environ.get(native.VARIABLE)
    try:
        build = native.build_name()
    except UserError as error:
        return Finding(check, False, "none", str(error))
    if build or asked == native.TORCH:
        return Finding(check, True, build or f"none, as {native.VARIABLE} asks")
    hint = "numpy acts and torch learns, slower: run 'make setup' (needs AVX2)"
    return Finding(check, False, "none", hint)


def caches() -> Finding:
    kept = "; ".join(f"{what}: {where}" for what, where in places().items())
    return Finding("caches and logs", True, kept)


def library(name: str) -> Finding:
    try:
        return Finding(name, True, importlib.metadata.version(name))
    except importlib.metadata.PackageNotFoundError:
        return Finding(name, False, "missing", "run 'make setup'")


def underlay() -> Finding:
    distribution = os.environ.get("ROS_DISTRO") == "jazzy"
    try:
        module = importlib.import_module("rclpy")
    except ImportError as error:
        hint = "source /opt/ros/jazzy/setup.bash, then '. ./env.sh'"
        if not distribution:
            hint = "run 'make setup', then '. ./env.sh'"
        return Finding("ROS underlay", False, str(error).partition("\n")[0], hint)
    kind = "distribution" if distribution else f"wheels, {importlib.metadata.version('ros-rclpy')}"
    return Finding("ROS underlay", True, f"{kind}: {Path(str(module.__file__)).parent}")


def interfaces() -> Finding:
    try:
        importlib.import_module("crash_coach_interfaces.msg")
    except ImportError as error:
        return Finding("messages", False, str(error), "run 'make setup', then '. ./env.sh'")
    return Finding("messages", True, "crash_coach_interfaces")


def executables() -> Finding:
    from crash_coach_bringup.ros.probe import EXECUTABLES, find_executable

    names = []
    for package, executables_of in EXECUTABLES.items():
        for name in executables_of:
            try:
                find_executable(package, name)
            except FileNotFoundError as error:
                return Finding("executables", False, str(error), "run 'make setup'")
            names.append(name)
    return Finding("executables", True, ", ".join(names))


def shared_memory() -> Finding:
    if not (left := half_made(SHARED_MEMORY)):
        return Finding("shared memory", True, f"nothing half-made in {SHARED_MEMORY}")
    names = " ".join(map(str, left))
    hint = f"a node was killed while it made it, and others wait for it without end: rm {names}"
    return Finding("shared memory", False, names, hint)


def dds() -> Finding:
    from crash_coach_bringup.ros.probe import round_trip_ms

    try:
        value = round_trip_ms()
    except (TimeoutError, RuntimeError) as error:
        hint = "does a firewall block multicast or UDP on the loopback interface?"
        return Finding("DDS on this machine", False, str(error), hint)
    rmw = os.environ.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    return Finding("DDS on this machine", True, f"{rmw}, round trip {value:.1f} ms")


def examine() -> list[Finding]:
    """Every check; those that need ROS only where ROS was found."""
    findings = [python_version(), compiler(), disk(), threads(), blas_kernels()]
    findings += [compiled_kernels(), caches()]
    findings += [library(name) for name in LIBRARIES]
    findings += [underlay(), interfaces()]
    need_ros: list[Callable[[], Finding]] = [executables, shared_memory]
    if all(finding.ok for finding in findings[-2:]):
        findings += [check() for check in need_ros]
        if findings[-1].ok:  # or it could wait without end itself
            findings.append(dds())
    return findings


def doctor(
    json: Annotated[Path | None, typer.Option(help="Also write the findings to this file.")] = None,
) -> None:
    """Tells what was found on this machine and what is missing or in the way; then exit code 1."""
    check_json_target(json)
    findings = examine()
    rows = table("crash-coach doctor", ["check", "", "found", "what to do"])
    for row in findings:
        mark = "[green]ok[/green]" if row.ok else "[red]PROBLEM[/red]"
        rows.add_row(row.check, mark, row.found, row.hint)
    with written_first(json, {"findings": [asdict(row) for row in findings]}):
        console.print(rows)
    if not all(row.ok for row in findings):
        raise typer.Exit(1)
