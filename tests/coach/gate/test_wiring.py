"""Which topics a gate may relay: by resolved names."""

from __future__ import annotations

import pytest

from crash_coach_common.contract import UserError
from crash_coach_pkg.gate.wiring import check_wiring

ROBOTS = ("a", "b")


def test_different_topics_are_relayed() -> None:
    check_wiring(ROBOTS, ("/a/raw", "/b/raw"), ("/a/cmd", "/b/cmd"))
    check_wiring(("a",), ("/raw",), ("/cmd",))


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        (("/a/x", "/b/x"), ("/a/x", "/b/x"), r"feed itself.*listen for a on /a/x.*raw_topic"),
        (("/a/x", "/b/x"), ("/a/y", "/a/x"), "feed itself.*listen for a on /a/x"),  # a ring of two
        (("/x", "/x"), ("/a/y", "/b/y"), "raw_topic: a and b would share /x"),
        (("/a/x", "/b/x"), ("/y", "/y"), "command_topic: a and b would share /y"),
    ],
)
def test_loops_and_shared_topics_are_refused(
    inputs: tuple[str, str], outputs: tuple[str, str], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        check_wiring(ROBOTS, inputs, outputs)
