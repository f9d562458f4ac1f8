"""The executable `crash-coach`: ready for signals before anything else is loaded."""

from __future__ import annotations

from crash_coach_bringup.cli.signals import leave_at_once
from crash_coach_common.loading import loading


def main() -> None:
    leave_at_once()
    with loading():  # here: it takes its second
        from crash_coach_bringup.cli.main import main as run

    run()


if __name__ == "__main__":
    main()
