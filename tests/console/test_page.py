"""The page in a real browser, on real graphs."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest
from console_teams import WAIT_S, Teams, asking, console, deaf_page, messages
from hypothesis import given, seed, settings

from crash_coach_bringup.ros.graph import graph_environment
from crash_coach_pkg.coach.parameters import build_settings
from crash_coach_pkg.team import TeamSpec

if TYPE_CHECKING:
    from playwright.sync_api import Browser, ConsoleMessage, Error, Page

PLACES = "crashCoach.stages[0].places().map((place) => [place.x, place.y])"
MOVED = f"""(before) => {PLACES}.some(([x, y], i) =>
    Math.hypot(x - before[i][0], y - before[i][1]) > 3)"""
PHONE = {"width": 375, "height": 740}
DESK = {"width": 1600, "height": 1000}


@pytest.fixture(scope="module")
def tab(browser: Browser) -> Iterator[Page]:
    """One for all tests: the browser starts two processes for every other, a CPU second each."""
    made = browser.new_page()
    made.set_default_timeout(1000 * WAIT_S)
    yield made
    made.close()


@pytest.fixture
def page(tab: Page, teams: Teams) -> Iterator[Page]:
    """On the first team, drawn; every fault of both is cleared afterwards."""
    yield from on_graphs(tab, teams, teams.one, 1)


@pytest.fixture
def two(tab: Page, teams: Teams) -> Iterator[Page]:
    """On both teams."""
    yield from on_graphs(tab, teams, teams.both, 2)


def on_graphs(tab: Page, teams: Teams, address: str, stages: int) -> Iterator[Page]:
    yield from opened(tab, address, stages, "stage.places().length > 0 && stage.status.ready")
    teams.clear()


def opened(tab: Page, address: str, stages: int, drawn: str) -> Iterator[Page]:
    problems: list[str] = []

    def failed(error: Error) -> None:
        problems.append(str(error))

    def told(message: ConsoleMessage) -> None:
        if message.type == "error":
            problems.append(message.text)

    tab.on("pageerror", failed)
    tab.on("console", told)
    tab.set_viewport_size(DESK)  # type: ignore[arg-type]
    tab.goto(address)
    tab.wait_for_function(
        f"() => crashCoach.stages.length === {stages}"
        f" && crashCoach.stages.every((stage) => {drawn})"
    )
    yield tab
    tab.goto("about:blank")
    tab.remove_listener("pageerror", failed)
    tab.remove_listener("console", told)
    assert problems == []


def select(page: Page, robot: str) -> None:
    """A click on the robot where it is drawn, while the sim stands."""
    page.get_by_role("button", name="Pause").click()
    page.locator(".banner", has_text="paused").wait_for()
    chosen = page.locator(".chip[aria-pressed=true]", has_text=robot)
    deadline_s = time.monotonic() + WAIT_S
    click_s = 0.0
    while not chosen.is_visible():
        now_s = time.monotonic()
        assert now_s < deadline_s, f"clicks on {robot} do not choose it"
        if now_s >= click_s:
            # Where it stands may be told after the pause is: then one clicks once more.
            click_s = now_s + WAIT_S / 10
            page.wait_for_function("() => !crashCoach.stages[0].dirty")
            at = page.evaluate(
                f"crashCoach.stages[0].places().find((place) => place.name === {robot!r})"
            )
            page.locator("canvas").first.click(position={"x": at["x"], "y": at["y"]})
        page.wait_for_timeout(50)
    page.get_by_role("button", name="Go on").click()
    page.locator(".banner", has_text="paused").wait_for(state="hidden")


def armed(answer: str) -> tuple[int, int]:
    """(episode, step)"""
    told = re.search(r"armed at step (\d+) of episode (\d+)", answer)
    assert told is not None, answer
    return int(told[2]), int(told[1])


def test_robots_move_on_the_page(page: Page) -> None:
    before = page.evaluate(PLACES)
    assert len(before) == 2
    page.wait_for_function(MOVED, arg=before)


def test_a_click_mutes_a_robot_from_the_next_step_on_and_clear_all_clears(
    page: Page, teams: Teams
) -> None:
    select(page, "robot_1")
    page.get_by_role("button", name="Crash: mute").click()
    page.locator("#answer[data-state=ok]").wait_for()
    answer = page.locator("#answer").inner_text()
    assert answer.startswith("robot_1: mute from the next step on")
    assert teams.crashed_at(*armed(answer)) == [1, 0]
    page.locator(".chip[data-state=faulted]", has_text="robot_1").wait_for()
    page.locator(".events li", has_text="active").first.wait_for()
    page.get_by_role("button", name="Clear all").click()
    page.locator("#answer", has_text="every fault is cleared").wait_for()
    page.locator(".chip[data-state=ok]", has_text="robot_1").wait_for()


def test_keys_crash_two_robots_and_clear_one_of_them(page: Page, teams: Teams) -> None:
    for key in ("1", "x"):
        page.keyboard.press(key)
    page.locator("#answer", has_text="robot_1: mute").wait_for()
    for key in ("Escape", "2", "x"):
        page.keyboard.press(key)
    page.locator("#answer", has_text="robot_1, robot_2: mute").wait_for()
    assert teams.crashed_at(*armed(page.locator("#answer").inner_text())) == [1, 1]
    page.keyboard.press("c")
    page.locator("#answer", has_text="robot_2: cleared; still crashed: robot_1").wait_for()


def test_a_mode_with_its_parameters_from_the_next_episode(page: Page) -> None:
    page.locator(".chip", has_text="robot_2").click()
    page.select_option("#mode", "delay")
    page.fill("#parameter-steps", "4")
    page.get_by_label("the next episode").check()
    page.fill("#start", "2")
    page.fill("#duration", "3")
    page.get_by_role("button", name="Crash: delay").click()
    page.locator("#answer", has_text="robot_2: delay (steps 4) from the next episode on").wait_for()
    page.locator(".coach dd", has_text="delay").wait_for()
    page.fill("#parameter-steps", "-1")  # out of its range: the form keeps it
    assert not page.evaluate("document.getElementById('faults').checkValidity()")


def refused(page: Page, mode: str) -> str:
    """What is answered where robot_1 is to crash so and cannot."""
    page.locator(".chip", has_text="robot_1").click()
    page.select_option("#mode", mode)
    page.get_by_role("button", name=f"Crash: {mode}").click()
    answer = page.locator("#answer[data-state=bad]")
    answer.wait_for()
    return answer.inner_text()


def test_why_a_plan_is_refused_is_shown(page: Page) -> None:
    # What the coach cannot know of its gate: that its commands have no velocities.
    told = refused(page, "bias")
    assert re.search(r"refused: the gate refused: .*velocities", told), told
    page.locator(".events li[data-kind=refused]", has_text="velocities").first.wait_for()


def test_why_the_coach_refuses_what_its_gate_could_not_do_is_shown(page: Page) -> None:
    # By the gate itself where the coach does not know its topics yet.
    told = refused(page, "blind")
    assert re.search(r"refused: the gate (would refuse|refused): .*observations", told), told


def test_two_teams_side_by_side_are_crashed_alike_or_one_alone(two: Page, teams: Teams) -> None:
    left, right = two.locator(".stage").all()
    boxes = [stage.bounding_box() for stage in (left, right)]
    assert boxes[0] is not None
    assert boxes[1] is not None
    assert abs(boxes[0]["y"] - boxes[1]["y"]) < 2
    assert boxes[0]["x"] + boxes[0]["width"] <= boxes[1]["x"]
    two.keyboard.press("1")
    two.keyboard.press("x")
    for stage in (left, right):
        stage.locator(".chip[data-state=faulted]", has_text="robot_1").wait_for()
    two.keyboard.press("C")
    for stage in (left, right):
        stage.locator(".chip[data-state=ok]", has_text="robot_1").wait_for()
    two.select_option("#team", "1")
    two.keyboard.press("x")
    two.locator("#answer", has_text="armed").wait_for()
    right.locator(".chip[data-state=faulted]", has_text="robot_1").wait_for()
    assert left.locator(".chip[data-state=faulted]").count() == 0


@pytest.fixture
def over(tab: Page, episodes: str) -> Iterator[Page]:
    """A recording, and beside it a run, without ROS."""
    yield from opened(tab, episodes, 2, "stage.places().length > 0")


STEP = "() => crashCoach.stages[{}].motion.newest.step"


def test_a_recording_plays_pauses_and_goes_to_any_step(over: Page) -> None:
    bag = over.locator(".stage").first
    bag.locator(".episode input").fill("0")
    bag.locator(".episode input").press("Enter")
    over.wait_for_function("() => crashCoach.stages[0].motion.newest.step >= 2")
    bag.get_by_role("button", name="Pause").click()
    bag.get_by_role("button", name="Play").wait_for()
    at = over.evaluate(STEP.format(0))
    bag.get_by_role("button", name="◂ Step").click()
    over.wait_for_function(f"() => crashCoach.stages[0].motion.newest.step === {at - 1}")
    bag.get_by_label("Step of the episode").fill("5")
    over.wait_for_function("() => crashCoach.stages[0].motion.newest.step === 5")
    bag.locator(".speed select").select_option("10")
    bag.get_by_role("button", name="Play").click()
    over.wait_for_function("() => crashCoach.stages[0].motion.newest.ended")
    bag.locator(".costs tbody tr").first.wait_for()


def test_a_run_is_crashed_in_the_same_episode_by_a_double_click(over: Page) -> None:
    run = over.locator(".stage").nth(1)
    run.locator(".step").click()  # it plays from the start on, and would play on from step 4
    over.wait_for_function("() => !crashCoach.stages[1].timeline.playing")
    run.get_by_label("Step of the episode").fill("4")
    over.wait_for_function("() => crashCoach.stages[1].motion.newest.step === 4")
    over.wait_for_function("() => !crashCoach.stages[1].dirty")
    at = over.evaluate("crashCoach.stages[1].places()[1]")
    run.locator("canvas.arena, .arena canvas").dblclick(position={"x": at["x"], "y": at["y"]})
    answer = over.locator("#answer", has_text="robot_2: mute from the next step on (from step 4")
    answer.wait_for()
    run.locator(".chip[data-state=faulted]", has_text="robot_2").wait_for()
    run.locator(".costs tbody tr", has_text="robot_2: mute").wait_for()
    over.keyboard.press("C")
    over.locator("#answer", has_text="nobody is crashed any more").wait_for()


@pytest.mark.parametrize("size", [PHONE, DESK], ids=["375px", "1600px"])
def test_nothing_is_cut_off(page: Page, size: dict[str, int]) -> None:
    page.set_viewport_size(size)  # type: ignore[arg-type]
    assert page.evaluate("document.documentElement.scrollWidth") <= size["width"]
    for name in ("Crash", "Clear all", "Pause"):
        box = page.get_by_role("button", name=name, exact=True).bounding_box()
        assert box is not None
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= size["width"]
    select(page, "robot_2")


def test_every_control_has_a_name_for_readers_of_the_screen(page: Page) -> None:
    unnamed = page.evaluate(
        """[...document.querySelectorAll("button, input, select, canvas")].filter((element) =>
            element.checkVisibility() && !element.textContent.trim() && !element.ariaLabel
            && !element.getAttribute("aria-label") && !element.labels?.length)
            .map((element) => element.outerHTML)"""
    )
    assert unnamed == []


def test_a_browser_that_does_not_read_stops_neither_graph_nor_pages(
    page: Page, teams: Teams
) -> None:
    with deaf_page(teams.one):
        before, steps = page.evaluate(PLACES), len(teams.crashed)
        teams.clients[0].until(lambda: len(teams.crashed) > steps + 5, WAIT_S, "control steps")
        page.wait_for_function(MOVED, arg=before)


def test_a_killed_console_leaves_no_fault_where_it_said_so(teams: Teams) -> None:
    environment = {**os.environ, **graph_environment(teams.domains[0])}
    with console(environment, "--end-faults", killed=True) as address, asking(address) as ask:
        assert ask.status()["ends_faults"]
        answer = ask(type="inject", victims=["robot_1"], mode="mute")
        assert teams.crashed_at(*armed(answer["text"])) == [1, 0]
    teams.clients[0].until(lambda: teams.newest() == [0, 0], WAIT_S, "nobody crashed")


@pytest.mark.parametrize(
    "count", [15, pytest.param(1000, marks=[pytest.mark.soak, pytest.mark.timeout(900)])]
)
def test_random_messages_get_an_error_each_and_leave_a_valid_coach(
    teams: Teams, count: int
) -> None:
    """Some of them are valid, and do what they say."""
    with asking(teams.one) as ask:

        @seed(11)
        @settings(max_examples=count, database=None)
        @given(messages())
        def send(text: str) -> None:
            answer = ask.text(text)
            assert isinstance(answer["ok"], bool)
            assert answer["ok"] or answer["text"]

        send()
        assert ask(type="pause", on=False)["ok"]
        assert ask(type="clear", robots=[])["ok"]
    values = teams.parameters()
    build_settings(values, TeamSpec(("robot_1", "robot_2"), (), 1.0))
    assert values["robots"] == ("robot_1", "robot_2")
