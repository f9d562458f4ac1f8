"""Benchmark rows of the console: what an open page costs a graph, and the console itself.

Run alone: ``python -m benchmarks bench_console``. Rates with and without the console are those of
one graph, in turn.
"""

from __future__ import annotations

import itertools
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import yaml
from crash_coach_interfaces.msg import FaultEvent
from websockets.sync.client import connect

from benchmarks.bench_ros import START_S, WARM_UP_S, WINDOW_S, refuse_dead, sample, untrained
from crash_coach_bringup.ros.client import graph_client
from crash_coach_bringup.ros.domain import reserve_domain
from crash_coach_bringup.ros.graph import (
    UpOptions,
    check_team,
    graph_environment,
    graph_processes,
)
from crash_coach_bringup.ros.supervisor import Supervisor
from sim_pkg.env import make_env

PAIRS = 4
TARGET_SHARE, PICTURES_HZ = 0.9, 30.0
MANY, HZ = 32, 10.0
FLOOD_HZ, BURST_S = 2000.0, 0.02
Row = dict[str, Any]


@contextmanager
def console_of(domain: int) -> Iterator[tuple[str, psutil.Process]]:
    """The address of a console of its own process."""
    command = [sys.executable, "-m", "crash_coach_console.command", "--port", "0"]
    console = subprocess.Popen(
        [*command, "--domain", str(domain)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert console.stdout is not None
        address = console.stdout.readline().removeprefix("console: http://").strip()
        yield address, psutil.Process(console.pid)
    finally:
        console.terminate()
        console.wait()


@contextmanager
def open_page(domain: int) -> Iterator[psutil.Process]:
    """A console, and a page that reads all it is told."""
    with console_of(domain) as (address, process):
        stop, drawn = threading.Event(), threading.Event()

        def read() -> None:
            with connect(f"ws://{address}live", open_timeout=START_S) as page:
                while not stop.is_set():
                    if '"type":"state"' in str(page.recv(timeout=START_S)):
                        drawn.set()

        reader = threading.Thread(target=read)
        reader.start()
        if not drawn.wait(START_S):
            raise RuntimeError("the console showed nothing")
        yield process
        stop.set()
        reader.join()


def rate(client: Any, supervisor: Supervisor, dt_s: float) -> float:
    """Control steps per second."""
    refuse_dead(supervisor, WARM_UP_S)
    start_s, first = sample(client, dt_s)
    refuse_dead(supervisor, WINDOW_S)
    end_s, last = sample(client, dt_s)
    return (last - first) / (end_s - start_s)


def running(
    stack: ExitStack, folder: Path, scenario: str, **options: Any
) -> tuple[int, Any, Supervisor, float]:
    """A graph of untrained robots: its domain, a client, its processes and dt_s."""
    spec = make_env(scenario, 1).spec
    up = UpOptions(scenario, untrained(folder, spec), layout="team", **options)
    domain = stack.enter_context(reserve_domain())
    supervisor = stack.enter_context(
        Supervisor(
            graph_processes(up, check_team(up)),
            folder / "logs",
            graph_environment(domain),
            throughput=up.mode == "lockstep",
        )
    )
    client = stack.enter_context(
        graph_client("meter", domain, lambda: refuse_dead(supervisor, 0.0))
    )
    return domain, client, supervisor, spec.dt_s


def cost_row(folder: Path) -> Row:
    """Lock-step, 8 robots: the rate with a page open over that without."""
    pairs = []
    with ExitStack() as stack:
        domain, client, supervisor, dt_s = running(stack, folder, "buttons_8")
        sample(client, dt_s)
        for _ in range(PAIRS):
            without = rate(client, supervisor, dt_s)
            with open_page(domain):
                pairs.append((rate(client, supervisor, dt_s), without))
    ratio = statistics.median(shown / without for shown, without in pairs)
    return {
        "name": "console lock-step 8 robots, a page open against none",
        "value": round(statistics.median(shown for shown, _ in pairs), 1),
        "unit": "steps/s",
        "reference": round(statistics.median(without for _, without in pairs), 1),
        "ratio": round(ratio, 3),
        "target": f">= {TARGET_SHARE:g}",
        "ok": ratio >= TARGET_SHARE,
    }


def many_robots(folder: Path) -> Path:
    """A grid-world of MANY robots, made of the one of 16."""
    shipped = Path(make_env.__code__.co_filename).parent / "configs/scenarios/buttons_16.yaml"
    config = yaml.safe_load(shipped.read_text())
    taken = {tuple(cell) for cell in config["starts"] + config["buttons"]}
    free = [[r, c] for r in range(10) for c in range(10) if (r, c) not in taken]
    config["starts"] += free[: MANY - len(config["starts"])]
    path = folder / f"buttons_{MANY}.yaml"
    path.write_text(yaml.safe_dump(config))
    return path


def share_of(console: psutil.Process, supervisor: Supervisor) -> float:
    """Of one core."""
    refuse_dead(supervisor, WARM_UP_S)
    before, start_s = sum(console.cpu_times()[:2]), time.perf_counter()
    refuse_dead(supervisor, 2 * WINDOW_S)
    return float(sum(console.cpu_times()[:2]) - before) / (time.perf_counter() - start_s)


@contextmanager
def flood(node: Any) -> Iterator[None]:
    """FLOOD_HZ effects on the first robot, of one step after the other."""
    events = node.create_publisher(FaultEvent, "coach/events", 1000)
    stop, step = threading.Event(), itertools.count()

    def send() -> None:
        while not stop.wait(BURST_S):
            for _ in range(round(FLOOD_HZ * BURST_S)):
                event = FaultEvent(kind=FaultEvent.EFFECT, robot="robot_1", mode="random")
                event.step = next(step)
                events.publish(event)

    sender = threading.Thread(target=send)
    sender.start()
    yield
    stop.set()
    sender.join()
    node.destroy_publisher(events)


def flood_row(folder: Path) -> Row:
    """The console's share of one core while the gate tells FLOOD_HZ effects, and while none."""
    with ExitStack() as stack:
        domain, client, supervisor, dt_s = running(
            stack, folder, "buttons", mode="realtime", sim={"real_time_factor": HZ}
        )
        sample(client, dt_s)
        with open_page(domain) as console:
            calm = share_of(console, supervisor)
            with flood(client.node):
                flooded = share_of(console, supervisor)
    return {
        "name": f"console CPU, {FLOOD_HZ:,.0f} EFFECT events/s at most, against none, a page open",
        "value": round(100 * flooded, 1),
        "unit": "% of a core",
        "reference": round(100 * calm, 1),
        "ratio": None,
        "target": None,
        "ok": True,
    }


def share_row(folder: Path) -> Row:
    """Real time, MANY robots at HZ: the console's share of one core."""
    with ExitStack() as stack:
        scenario = str(many_robots(folder))
        sim = {"real_time_factor": HZ}  # a control step is one second
        domain, client, supervisor, dt_s = running(
            stack, folder, scenario, mode="realtime", sim=sim
        )
        sample(client, dt_s)
        with open_page(domain) as console:
            share = share_of(console, supervisor)
    return {
        "name": f"console CPU, {MANY} robots at {HZ:g} Hz in real time, a page open",
        "value": round(100 * share, 1),
        "unit": "% of a core",
        "reference": None,
        "ratio": None,
        "target": None,
        "ok": True,
    }


# Pictures in which some robot stands elsewhere than in the one before, of the page's first stage.
COUNT = """(seconds) => new Promise((done) => {
  const stage = crashCoach.stages[0], began = performance.now();
  let before = "", pictures = 0, frames = 0;
  const look = () => {
    const places = JSON.stringify(stage.places().map((place) => [place.x, place.y]));
    if (places !== before) pictures += 1;
    before = places;
    frames += 1;
    const passed = (performance.now() - began) / 1000;
    if (passed < seconds) requestAnimationFrame(look);
    else done([pictures / passed, frames / passed]);
  };
  requestAnimationFrame(look);
})"""


def frames_row(folder: Path) -> Row:
    """Real time, MANY robots that move at random, in a headless browser without a graphics card."""
    from playwright.sync_api import sync_playwright

    with ExitStack() as stack:
        scenario, sim = str(many_robots(folder)), {"real_time_factor": HZ}
        domain, client, supervisor, dt_s = running(
            stack, folder, scenario, mode="realtime", sim=sim, epsilon=1.0
        )
        sample(client, dt_s)
        address, _ = stack.enter_context(console_of(domain))
        playwright = stack.enter_context(sync_playwright())
        browser = playwright.chromium.launch(
            executable_path=chromium(), args=["--no-sandbox", "--disable-gpu"]
        )
        page = browser.new_page(viewport={"width": 1600, "height": 1000})
        page.goto(f"http://{address}")
        page.wait_for_function(
            "() => crashCoach.stages.length && crashCoach.stages[0].places().length > 0",
            timeout=1000 * START_S,
        )
        refuse_dead(supervisor, WARM_UP_S)
        pictures_hz, frames_hz = page.evaluate(COUNT, WINDOW_S)
        browser.close()
    return {
        "name": f"console pictures, {MANY} robots moving at {HZ:g} Hz, headless browser",
        "value": round(pictures_hz, 1),
        "unit": "pictures/s",
        "reference": round(frames_hz, 1),  # what the browser's own clock offered
        "ratio": round(pictures_hz / frames_hz, 3),
        "target": f">= {PICTURES_HZ:g}",
        "ok": pictures_hz >= PICTURES_HZ,
    }


def chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser")


def rows() -> list[Row]:
    """All rows: {name, value, unit, reference, ratio, target, ok}."""
    with tempfile.TemporaryDirectory(prefix="crash_coach_bench_") as text:
        folder = Path(text)
        made = [cost_row(folder), share_row(folder), flood_row(folder)]
        return made if chromium() is None else [*made, frames_row(folder)]
