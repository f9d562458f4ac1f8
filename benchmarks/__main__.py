"""Runs every bench_*.py, prints one table and writes runs/bench.json.

Each module has ``rows()``, which returns dicts with the keys of KEYS: ``value`` in ``unit``,
``reference`` measured in the same run where there is one, ``ratio`` of the two, ``target``, and
``ok``, whether the target is met (None without a target).
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from crash_coach_bringup.cli.fitted_table import FittedConsole, FittedTable

KEYS = ("name", "value", "unit", "reference", "ratio", "target", "ok")
HERE = Path(__file__).parent


def figure(value: Any) -> str:
    if isinstance(value, bool):
        return "[green]yes[/green]" if value else "[red]NO[/red]"
    if isinstance(value, float | int):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return "" if value is None else str(value)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("only", nargs="*", help="modules, e.g. bench_ros; default: all")
    parser.add_argument("--out", type=Path, default=Path("runs/bench.json"))
    arguments = parser.parse_args()
    known = sorted(path.stem for path in HERE.glob("bench_*.py"))
    unknown = sorted(set(arguments.only) - set(known))
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}; one of: {', '.join(known)}")
    # One thread per process, as everywhere; before a module loads a BLAS.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    console = FittedConsole()
    rows: list[dict[str, Any]] = []
    for name in arguments.only or known:
        console.print(f"{name} ...")
        for row in importlib.import_module(f"benchmarks.{name}").rows():
            rows.append({key: row[key] for key in KEYS})
    table = FittedTable(title="make bench", title_justify="left")
    for key in KEYS:
        table.add_column(key, justify="left" if key in ("name", "unit") else "right")
    for row in rows:
        table.add_row(*(figure(row[key]) for key in KEYS))
    console.print(table)
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(rows, indent=2) + "\n")
    console.print(f"written to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
