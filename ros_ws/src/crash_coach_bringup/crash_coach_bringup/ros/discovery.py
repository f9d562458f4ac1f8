"""Quick discovery of the nodes that crash-coach starts; see config/fastdds.xml."""

from __future__ import annotations

import os
from pathlib import Path

from ament_index_python.packages import PackageNotFoundError, get_package_share_directory

from crash_coach_common.contract import UserError

VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"


def profiles_file() -> str:
    """The user's own choice in the environment, or ours.

    Raises:
        UserError: the workspace was built without the file, or is not sourced.
    """
    if VARIABLE in os.environ:
        return os.environ[VARIABLE]
    try:
        path = Path(get_package_share_directory("crash_coach_bringup")) / "config" / "fastdds.xml"
    except PackageNotFoundError:
        raise UserError(
            "package crash_coach_bringup is not on AMENT_PREFIX_PATH: run 'make setup', then "
            "'. ./env.sh'"
        ) from None
    if not path.is_file():
        raise UserError(f"{path} is not installed: run 'make setup'")
    return str(path)


def use_quick_discovery() -> None:
    """For this process, before its first node: Fast DDS reads the variable then, and only then."""
    os.environ[VARIABLE] = profiles_file()
