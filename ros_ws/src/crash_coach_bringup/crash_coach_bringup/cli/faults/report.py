"""The files of `crash-coach faults run --out`: report, JUnit XML, effect log, figures.

They are written whole or not at all: a folder beside the target takes its place at the end.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from crash_coach_bringup.cli.markdown import table
from crash_coach_bringup.cli.output import CliError, not_written, percent_ci
from crash_coach_bringup.cli.playing import ALIKE
from crash_coach_common.whole_output import check_folder, folder_made
from policy_pkg.play.evaluate import Evaluation
from policy_pkg.report.verdict import FaultRun, Verdict

REPORT, JUNIT, EVENTS, RESULT = "report.md", "junit.xml", "events.jsonl", "result.json"
FIGURES = ("success.png", "returns.png", "timeline.png")
MOST_LOST = 20  # episodes in the table of lost ones
FILES = frozenset((REPORT, JUNIT, EVENTS, RESULT, *FIGURES))
_NOT_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


@dataclass(frozen=True)
class Played:
    """What was run, and how."""

    name: str  # of the fault scenario
    description: str
    team: str
    scenario: str
    via: str
    layout: str | None  # None: in this process
    seed: int
    episodes: int
    began: datetime  # with its time zone
    seconds: float  # wall time

    def reproducible(self) -> dict[str, Any]:
        """What a second run has in common with this one."""
        values = asdict(self)
        return {key: values[key] for key in values if key not in ("began", "seconds")}


def measured(verdict: Verdict) -> str:
    """'87.5 % (79.0..93.1) of 64', '100.0 % (1 episode)', '-0.25', or why there is nothing."""
    finding = verdict.finding
    if finding.measured is None:
        return finding.note
    text = f"{finding.measured:.4g}"
    if finding.counts is not None:
        interval = verdict.interval
        bounds = None if interval is None else (interval.low, interval.high)
        text = percent_ci(finding.measured, bounds)
        if interval is not None:
            text += f" of {finding.counts[1]}"
    return f"{text}; {finding.note}" if finding.note else text


def check_target(out: Path) -> None:
    """Refuses a folder that cannot take the report before the work, not after it.

    Raises:
        CliError: nowhere to put it, or something in the way that is not a report.
    """
    try:
        check_folder(out.resolve().parent, out)
    except OSError as error:
        raise CliError(f"--out {out}: {error.strerror}") from None
    if not os.path.exists(out):
        return
    try:
        foreign = sorted(set(os.listdir(out)) - FILES)
    except NotADirectoryError:
        raise CliError(f"--out {out}: is not a folder") from None
    except OSError as error:
        raise CliError(f"--out {out}: cannot be read: {error.strerror}") from None
    if foreign:
        raise CliError(f"--out {out}: holds {foreign[0]!r}, which no report has; name a new folder")


def write(out: Path, played: Played, run: FaultRun) -> None:
    """Writes all FILES into ``out``; an earlier report there is replaced.

    Raises:
        CliError: as check_target, or it cannot be written; then ``out`` is as it was.
    """
    # Imported here: no other verb should wait for matplotlib.
    from crash_coach_bringup.cli.faults.figures import figures

    check_target(out)
    texts = {
        REPORT: report(played, run),
        JUNIT: junit(played, run),
        EVENTS: events(run),
        RESULT: json.dumps(result(played, run), indent=2) + "\n",
    }
    # Names of files need not be UTF-8.
    encoded = {name: text.encode(errors="replace") for name, text in texts.items()}
    content = encoded | figures(run)
    _replace(out, content)


def _replace(out: Path, content: Mapping[str, bytes]) -> None:
    out = out.resolve()  # a link stays, and what it leads to is replaced
    new = out.with_name(f".{out.name}.{os.getpid()}.partial")
    old = out.with_name(f".{out.name}.{os.getpid()}.old")
    moved = False
    try:
        with folder_made(out.parent):
            new.mkdir()
            for name, data in content.items():
                (new / name).write_bytes(data)
            if out.exists():
                out.rename(old)
                moved = True
            new.rename(out)
    except OSError as error:
        if moved:
            old.rename(out)
        raise CliError(not_written("--out", out, error)) from None
    finally:
        shutil.rmtree(new, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def events(run: FaultRun) -> str:
    """One JSON object per line: the effect log, sorted, of the faulted episodes."""
    return "".join(json.dumps(row._asdict()) + "\n" for row in run.faulted.effects)


def events_sha256(run: FaultRun) -> str:
    return hashlib.sha256(events(run).encode()).hexdigest()


def result(played: Played, run: FaultRun) -> dict[str, Any]:
    """JSON values; equal runs give equal ones."""
    return {
        **played.reproducible(),
        "passed": run.passed,
        "verdicts": [
            {
                "expectation": verdict.name,
                "wanted": verdict.wanted,
                **asdict(verdict.finding),
                "ci95": verdict.interval and [verdict.interval.low, verdict.interval.high],
            }
            for verdict in run.verdicts
        ],
        "faulted": run.faulted.summary(),
        "crash_free": run.crash_free.summary(),
        "entries": [asdict(entry) for entry in run.entries],
        "events_sha256": events_sha256(run),
        "pairs": [asdict(pair) for pair in run.trials.pairs],
    }


def junit(played: Played, run: FaultRun) -> str:
    """One test case per expectation, as Jenkins, GitLab and GitHub's viewers read it."""
    status = [verdict.finding.status for verdict in run.verdicts]
    counts = {
        "tests": str(len(status)),
        "failures": str(status.count("failed")),
        "errors": str(status.count("error")),
        "time": f"{played.seconds:.3f}",
    }
    root = ElementTree.Element("testsuites", {"name": "crash-coach faults", **counts})
    about = {"name": _xml(played.name), "timestamp": played.began.isoformat(timespec="seconds")}
    suite = ElementTree.SubElement(root, "testsuite", {**about, "skipped": "0", **counts})
    properties = ElementTree.SubElement(suite, "properties")
    for key, value in played.reproducible().items():
        if value is not None:
            ElementTree.SubElement(properties, "property", name=key, value=_xml(str(value)))
    for verdict in run.verdicts:
        _case(suite, played, verdict)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _case(suite: ElementTree.Element, played: Played, verdict: Verdict) -> None:
    name = _xml(verdict.wanted)
    case = ElementTree.SubElement(
        suite, "testcase", classname=_xml(f"faults.{played.name}"), name=name, time="0"
    )
    if not verdict.passed:
        tag = "failure" if verdict.finding.status == "failed" else "error"
        text = _xml(f"wanted: {verdict.wanted}; measured: {measured(verdict)}")
        ElementTree.SubElement(case, tag, message=text, type=verdict.name).text = text


def _xml(text: str) -> str:
    """Without characters that XML cannot hold, not even escaped."""
    return _NOT_XML.sub("\ufffd", text)


def report(played: Played, run: FaultRun) -> str:
    """The Markdown page."""
    where = f"over ROS (layout {played.layout})" if played.layout else "in one process"
    parts = [
        f"# Fault scenario {played.name}: {'passed' if run.passed else 'FAILED'}",
        played.description,
        f"Team `{played.team}` on `{played.scenario}`: {played.episodes} episodes, seed "
        f"{played.seed}, {where}; each episode also without the faults.",
        "## Expectations",
        table(
            ("expected", "measured (95 % Wilson interval)", "verdict"),
            ((v.wanted, measured(v), v.finding.status) for v in run.verdicts),
        ),
        "## With the faults and without",
        table(
            ("", "success", "return", "steps", "robots faulted", "trajectory hash"),
            (
                _figures("crash-free", run.crash_free),
                _figures("with the faults", run.faulted),
            ),
        ),
        *([ALIKE] if run.faulted.alike or run.crash_free.alike else []),
        "![Success rates](success.png)",
        "![Returns of each pair](returns.png)",
        "## What each entry did",
        table(
            ("entry", "mode", "faults due", "took effect", "robot-steps"),
            ((e.entry, e.mode, e.due, e.took_effect, e.robot_steps) for e in run.entries),
        ),
        "![Faults of one episode over time](timeline.png)",
        *_lost(run),
        f"Effect log: {len(run.faulted.effects)} events, SHA-256 `{events_sha256(run)}`.",
    ]
    return "\n\n".join(parts) + "\n"


def _lost(run: FaultRun) -> list[str]:
    """The section on episodes that the faults cost; nothing without one."""
    lost = [p for p in run.trials.pairs if p.crash_free.success and not p.faulted.success]
    if not lost:
        return []
    shown = lost[:MOST_LOST]
    rows = [
        (
            pair.episode,
            ", ".join(dict.fromkeys(fault.robot for fault in pair.due)),
            f"{pair.crash_free.episode_return:.3f} → {pair.faulted.episode_return:.3f}",
        )
        for pair in shown
    ]
    title = f"## Episodes lost to the faults: {len(lost)} of {len(run.trials.pairs)}"
    if len(shown) < len(lost):
        title += f" (the first {len(shown)})"
    return [title, table(("episode", "robots with faults due", "return"), rows)]


def _figures(name: str, evaluation: Evaluation) -> tuple[str, ...]:
    figures = evaluation.summary()
    return (
        name,
        percent_ci(figures["success_rate"], figures["success_ci95"]),
        f"{figures['return_mean']:.3f}"
        + ("" if evaluation.alike else f" ± {figures['return_std']:.3f}"),
        f"{figures['steps_mean']:.1f}",
        f"{100 * figures['crashed_fraction']:.1f} %",
        f"`{figures['trajectory_hash']}`",
    )
