#!/usr/bin/env python3
"""Sets Crash Coach up in this checkout: .venv, pinned packages, built ROS workspace.

Run by `make setup` with any Python; needs only the standard library. Every stage leaves a
stamp with a fingerprint of what it was made from, so a second call does nothing and an
interrupted one goes on where it stopped.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMPS = VENV / ".crash_coach"
WORKSPACE = ROOT / "ros_ws"
KERNELS = ROOT / "policy_pkg/policy_pkg/native"
# Both give the same bits (the source says why): acting and learning take the best that runs here.
KERNEL_FLAGS = {"avx2": ["-mavx2", "-mfma"], "avx512": ["-mavx512f", "-mavx2", "-mfma"]}
KERNEL_OPTIONS = ["-std=c++17", "-O3", "-ffp-contract=off", "-fPIC", "-shared"]
LOCK = ROOT / "requirements.lock"
LOOPS = ROOT / "scripts" / "compile_loops.py"

UV_VERSION = "0.13.9"
OLDEST, NEWEST = (3, 11), (3, 14)
JAZZY = (3, 12)  # what a Jazzy distribution's rclpy is compiled for
DISK_BYTES = 8 * 10**9  # torch for x86-64 alone unpacks to about 6 GB

# The ROS wheels export CMake files that name the machine they were built on.
BUILD_MACHINE = re.compile(
    r"/opt/python/cp\d+-cp\d+t?"
    r"(?P<numpy>/lib/python3\.\d+t?/site-packages/numpy/_core/include)?"
    r"(?P<include>/include/python3\.\d+t?)?"
)


class SetupError(Exception):
    """What this machine lacks, and what to do about it."""


def underlay() -> str:
    """'distribution' where a Jazzy distribution is sourced, otherwise 'wheels'."""
    distro = os.environ.get("ROS_DISTRO", "")
    if distro in ("", "jazzy"):
        return "distribution" if distro else "wheels"
    raise SetupError(
        f"ROS_DISTRO is {distro!r}, but Crash Coach needs 'jazzy': open a shell in which "
        f"{distro} is not sourced, or source /opt/ros/jazzy/setup.bash"
    )


def check_machine() -> None:
    if sys.platform != "linux" or platform.machine() != "x86_64":
        if underlay() == "wheels":
            raise SetupError(
                f"the ROS 2 wheels exist for Linux on x86-64, this is {sys.platform} on "
                f"{platform.machine()}: install ROS 2 Jazzy and source it first"
            )
    for tool in ("c++", "cc"):
        if shutil.which(tool) is None:
            raise SetupError(
                f"no C/C++ compiler ({tool!r}) on PATH, needed to generate the ROS messages: "
                "install one, on Debian and Ubuntu with: apt-get install build-essential"
            )
    if not (STAMPS / "packages").exists():
        free = shutil.disk_usage(ROOT).free
        if free < DISK_BYTES:
            raise SetupError(
                f"{free / 1e9:.1f} GB free under {ROOT}, but {DISK_BYTES / 1e9:.0f} GB are needed "
                "(torch alone unpacks to about 6 GB): free some space"
            )


def version_of(python: str) -> tuple[int, int] | None:
    """(major, minor) of an interpreter, None where it does not run."""
    code = "import sys; print(*sys.version_info[:2])"
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode != 0:
        return None
    major, minor = done.stdout.split()
    return int(major), int(minor)


def find_python(ros: str) -> str:
    """An interpreter that ``ros`` takes; $PYTHON first, then python3, then python3.x."""
    oldest, newest = (JAZZY, JAZZY) if ros == "distribution" else (OLDEST, NEWEST)
    asked = os.environ.get("PYTHON")
    names = (
        [asked] if asked else ["python3", "python3.12", "python3.13", "python3.11", "python3.14"]
    )
    found = []
    for name in names:
        version = version_of(name)
        if version is None:
            continue
        if oldest <= version <= newest:
            return name
        found.append(f"{name} is {version[0]}.{version[1]}")
    wanted = f"{oldest[0]}.{oldest[1]}"
    if oldest != newest:
        wanted += f" to {newest[0]}.{newest[1]}"
    why = ", which the sourced Jazzy distribution is built for," if ros == "distribution" else ""
    raise SetupError(
        f"no Python {wanted}{why} found "
        f"({'; '.join(found) or 'none of ' + ', '.join(names) + ' runs'}): "
        "install one, or name it: make setup PYTHON=/path/to/python3.12"
    )


def run(command: list[str], log: Path, env: dict[str, str] | None = None, cwd: Path = ROOT) -> None:
    """Runs a command with its output in ``log``; shows the end of it where it fails."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "w") as out:
        done = subprocess.run(command, stdout=out, stderr=subprocess.STDOUT, env=env, cwd=cwd)
    if done.returncode != 0:
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-25:])
        raise SetupError(
            f"{' '.join(command[:6])} ... failed with exit code {done.returncode}:\n{tail}\n"
            f"(all of it: {log}; calling 'make setup' again goes on from here)"
        )


def fingerprint(parts: Iterable[str | Path]) -> str:
    """Hash of strings and of files' names and contents."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(str(part).encode() + b"\0")
        if isinstance(part, Path):
            sha.update(part.read_bytes())
    return sha.hexdigest()


def stage(name: str, what: str, print_of: str, action: Callable[[], None]) -> None:
    """Runs ``action`` unless its stamp holds the same fingerprint."""
    stamp = STAMPS / name
    if stamp.exists() and stamp.read_text() == print_of:
        return
    print(f"setup: {what} ...", flush=True)
    start = time.monotonic()
    stamp.unlink(missing_ok=True)
    action()
    STAMPS.mkdir(parents=True, exist_ok=True)
    stamp.write_text(print_of)
    print(f"setup: {what} took {time.monotonic() - start:.0f} s", flush=True)


def make_venv(python: str) -> None:
    run([python, "-m", "venv", "--clear", str(VENV)], ROOT / ".venv.log")
    pip = [str(PYTHON), "-m", "pip", "install", "--quiet", f"uv=={UV_VERSION}"]
    run(pip, VENV / "log" / "uv.log")
    (ROOT / ".venv.log").unlink()


def install_packages(ros: str) -> None:
    lines = LOCK.read_text().splitlines(keepends=True)
    if ros == "distribution":  # the distribution brings its own ROS packages
        lines = [line for line in lines if not line.startswith("ros-")]
    wanted = VENV / "requirements.txt"
    wanted.write_text("".join(lines))
    uv = [str(VENV / "bin" / "uv"), "pip", "install", "--python", str(PYTHON)]
    run([*uv, "--compile-bytecode", "-r", str(wanted)], VENV / "log" / "packages.log")
    rewrite_cmake_paths()


def rewrite_cmake_paths() -> int:
    """Points the wheels' CMake files at this environment; returns how many were changed."""
    code = (
        "import numpy, sysconfig; print(numpy.get_include()); print(sysconfig.get_path('include'))"
    )
    answer = subprocess.run([str(PYTHON), "-c", code], capture_output=True, text=True, check=True)
    numpy_include, python_include = answer.stdout.split()

    def here(match: re.Match[str]) -> str:
        if match["numpy"]:
            return numpy_include
        return python_include if match["include"] else str(VENV)

    changed = 0
    for folder in (VENV / "share", VENV / "lib" / "cmake"):
        for path in folder.rglob("*.cmake"):
            text = path.read_text()
            if BUILD_MACHINE.search(text):
                # A new file: uv's are hard links into its cache, which must stay as it is.
                fresh = path.with_suffix(".cmake.partial")
                fresh.write_text(BUILD_MACHINE.sub(here, text))
                os.replace(fresh, path)
                changed += 1
    return changed


def build_kernels() -> None:
    """The compiled kernels, for processors with and without AVX-512."""
    folder = VENV / "lib" / "crash_coach"
    folder.mkdir(parents=True, exist_ok=True)
    for name, flags in KERNEL_FLAGS.items():
        # A new file: a training that runs has the old one open.
        fresh = folder / f"kernels_{name}.partial"
        sources = map(str, sorted(KERNELS.glob("*.cpp")))
        command = ["c++", *KERNEL_OPTIONS, *flags, *sources, "-o", str(fresh)]
        run(command, VENV / "log" / "kernel.log")
        os.replace(fresh, folder / f"kernels_{name}.so")


def simulator_sources() -> list[Path]:
    return [LOOPS, *sorted((ROOT / "sim_pkg" / "sim_pkg").rglob("*.py"))]


def compile_loops() -> None:
    path = [ROOT / "sim_pkg", WORKSPACE / "src" / "crash_coach_common"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, path))}
    run([str(PYTHON), str(LOOPS)], VENV / "log" / "loops.log", env=env)


def workspace_sources() -> list[str | Path]:
    """What the build depends on; Python modules do not count, they are linked, not copied."""
    sources: list[str | Path] = []
    for package in sorted((WORKSPACE / "src").iterdir()):
        for pattern in ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt", "msg/*.msg"):
            sources += sorted(package.glob(pattern))
        for pattern in ("launch/*", "rviz/*", "config/*"):
            sources += [str(path.relative_to(WORKSPACE)) for path in sorted(package.glob(pattern))]
    return sources


def build_workspace(ros: str) -> None:
    env = {**os.environ, "VIRTUAL_ENV": str(VENV), "PATH": f"{VENV / 'bin'}:{os.environ['PATH']}"}
    if ros == "wheels":
        env["AMENT_PREFIX_PATH"] = env["CMAKE_PREFIX_PATH"] = str(VENV)
    colcon = [
        str(VENV / "bin" / "colcon"), "build", "--symlink-install",
        "--cmake-args", "-GNinja", f"-DPython3_EXECUTABLE={PYTHON}", "--no-warn-unused-cli",
    ]  # fmt: skip
    # A half-configured build folder keeps paths of an earlier environment.
    for folder in ("build", "install"):
        shutil.rmtree(WORKSPACE / folder, ignore_errors=True)
    run(colcon, VENV / "log" / "colcon.log", env=env, cwd=WORKSPACE)
    write_command()


def write_command() -> None:
    """.venv/bin/crash-coach: the command line with its environment, for any shell."""
    command = VENV / "bin" / "crash-coach"
    command.write_text(
        f'#!/usr/bin/env bash\n. "{ROOT}/env.sh" || exit 1\n'
        f'exec "{WORKSPACE}/install/crash_coach_bringup/lib/crash_coach_bringup/crash-coach" "$@"\n'
    )
    command.chmod(0o755)


def main() -> int:
    try:
        ros = underlay()
        check_machine()
        with open(ROOT / ".setup.lock", "w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            python = find_python(ros)
            base = fingerprint([str(ROOT), str(version_of(python)), UV_VERSION, ros])
            stage("venv", "virtual environment", base, lambda: make_venv(python))
            packages = fingerprint([base, LOCK])
            stage("packages", "packages (torch is large)", packages, lambda: install_packages(ros))
            if platform.machine() == "x86_64":  # elsewhere torch does the same, slower
                sources = [
                    path for path in sorted(KERNELS.iterdir()) if path.suffix in (".h", ".cpp")
                ]
                kernels = fingerprint([base, *sources, *KERNEL_OPTIONS, str(KERNEL_FLAGS)])
                stage("kernel", "compiled kernels", kernels, build_kernels)
            build = fingerprint([packages, *workspace_sources()])
            loops = fingerprint([packages, *simulator_sources()])
            with ThreadPoolExecutor() as beside:
                compiled = beside.submit(
                    stage, "loops", "simulator's compiled functions", loops, compile_loops
                )
                stage("workspace", "ROS workspace", build, lambda: build_workspace(ros))
                compiled.result()
    except SetupError as error:
        print(f"setup: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("setup: interrupted; calling it again goes on from here", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
