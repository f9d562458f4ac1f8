"""Where results go: pipes, links, devices, full and read-only disks, consoles without UTF-8."""

from __future__ import annotations

import errno
import io
import json
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from in_process import typed

from crash_coach_bringup.cli.output import CliError, check_file_target, written_first
from crash_coach_bringup.cli.terminal import PLAIN, degrade_characters
from crash_coach_common import whole_output
from crash_coach_common.whole_output import folder_made, kind_of, write_whole
from policy_pkg.untrained import write_untrained
from sim_pkg.env import make_env

BEGINNINGS = (b"{", b"\x89PNG", b"\0\0\0\x20ftyp")


@pytest.fixture(scope="module")
def team(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("policy") / "step_000000000"
    write_untrained(path, make_env("buttons", 1).spec, seed=1)
    return path


def read_in_background(pipe: Path) -> tuple[threading.Thread, list[bytes]]:
    found: list[bytes] = []
    reader = threading.Thread(target=lambda: found.append(pipe.read_bytes()), daemon=True)
    reader.start()
    return reader, found


@pytest.mark.parametrize("name", ["result.json", "picture.png", "film.mp4"])
def test_a_pipe_is_written_to_and_stays(tmp_path: Path, team: Path, name: str) -> None:
    pipe = tmp_path / name
    os.mkfifo(pipe)
    reader, found = read_in_background(pipe)
    if name.endswith(".json"):
        done = typed("evaluate", str(team), "--episodes", "1", "--json", str(pipe))
    else:
        done = typed("render", str(team), "--speed", "20", "--out", str(pipe))
    assert done.returncode == 0, done.stderr
    reader.join(30)
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    (content,) = found
    assert content[: {".json": 1, ".png": 4, ".mp4": 8}[pipe.suffix]] in BEGINNINGS
    assert [each.name for each in tmp_path.iterdir()] == [name]


def test_a_pipe_without_a_reader_is_an_error_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole_output, "READER_S", 0.1)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="nobody reads from it"):
        write_whole(tmp_path / "pipe", b"x")


def test_missing_folders_are_made_and_go_again_where_nothing_comes_of_it(
    tmp_path: Path, team: Path
) -> None:
    out = tmp_path / "a" / "b" / "picture.png"
    assert typed("render", str(team), "--out", str(out)).returncode == 0
    assert out.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(KeyError), folder_made(tmp_path / "a" / "c" / "d"):
        raise KeyError
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["b"]
    report = tmp_path / "new" / "report"
    run = ("faults", "run", "one_mute", "--policy", str(team), "--episodes", "2")
    assert typed(*run, "--out", str(report)).returncode == 1  # an untrained team
    assert (report / "report.md").is_file()
    refused = typed(*run, "--out", str(out / "report"))
    assert "picture.png is not a folder" in refused.stderr


def test_a_link_is_followed_and_the_file_keeps_its_permissions(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    real, link, dangling = tmp_path / "there/real", tmp_path / "link", tmp_path / "dangling"
    real.write_text("old")
    real.chmod(0o600)
    link.symlink_to("there/real")
    dangling.symlink_to("there/new")
    for path in (link, dangling):
        write_whole(path, b"new")
        assert path.is_symlink()
        assert path.read_bytes() == b"new"
    assert stat.S_IMODE(real.stat().st_mode) == 0o600
    assert sorted(p.name for p in (tmp_path / "there").iterdir()) == ["new", "real"]


def test_a_report_into_a_linked_folder_keeps_the_link(tmp_path: Path, team: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    out = str(tmp_path / "link")
    run = ("faults", "run", "one_mute", "--policy", str(team), "--episodes", "2", "--out", out)
    assert typed(*run).returncode == 1  # an untrained team
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real/report.md").is_file()


def test_a_device_is_written_to_and_a_disk_is_refused() -> None:
    write_whole(Path(os.devnull), b"x")
    assert stat.S_ISCHR(Path(os.devnull).stat().st_mode)
    kinds = {kind_of(kind): kind for kind in (stat.S_IFREG, stat.S_IFDIR, stat.S_IFBLK)}
    assert list(kinds) == ["file", "folder", "disk"]
    assert {kind_of(k) for k in (stat.S_IFIFO, stat.S_IFCHR, stat.S_IFSOCK)} == {"stream"}


def test_a_disk_is_refused_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(whole_output, "kind_of", lambda mode: "disk")
    with pytest.raises(CliError, match=r"--json .*: is a disk"):
        check_file_target("--json", tmp_path)


@pytest.mark.parametrize("to_a_file", [True, False])
def test_standard_output_by_its_name(tmp_path: Path, team: Path, to_a_file: bool) -> None:
    """The table and the JSON come out in full, also where standard output is a file."""
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "evaluate", str(team)]
    command += ["--episodes", "1", "--json", "/dev/stdout"]
    out = tmp_path / "out"
    if to_a_file:
        with out.open("wb") as file:
            subprocess.run(command, stdout=file, check=True, timeout=250)
        text = out.read_text()
    else:
        text = subprocess.run(command, capture_output=True, check=True, timeout=250).stdout.decode()
    content, end = json.JSONDecoder().raw_decode(text)
    assert content["scenario"] == "buttons"
    assert "trajectory hash" in text[end:]


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_what_failed_first_is_said_and_what_was_computed_is_printed(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    number: int,
) -> None:
    """On a disk that is read-only even removing what is not there fails."""

    def full(path: Path, content: bytes) -> None:
        raise OSError(number, os.strerror(number), str(path))

    def read_only(path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, "the clean-up's own error")

    monkeypatch.setattr(Path, "write_bytes", full)
    monkeypatch.setattr(Path, "unlink", read_only)
    failed = pytest.raises(CliError, match=f"cannot be written: {os.strerror(number)}$")
    with failed, written_first(tmp_path / "result.json", {"a": 1}):
        print("what was computed")
    assert "what was computed" in capsys.readouterr().out


@pytest.mark.parametrize("encoding", ["ascii", "iso-8859-1"])
def test_characters_degrade_and_files_are_written(
    tmp_path: Path, team: Path, encoding: str
) -> None:
    result = tmp_path / "r.json"
    command = [sys.executable, "-m", "crash_coach_bringup.cli.main", "evaluate", str(team)]
    command += ["--episodes", "2", "--crashed", "0", "1", "--json", str(result)]
    env = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run(command, capture_output=True, env=env, timeout=250)
    assert done.returncode == 0, done.stderr
    plus_minus = {"ascii": "+/-", "iso-8859-1": "±"}[encoding]
    assert f"-20.00 {plus_minus} 0.00" in done.stdout.decode(encoding)
    assert json.loads(result.read_text())["conditions"]


def test_every_character_of_the_list_is_one_that_ascii_lacks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", out)
    degrade_characters()
    out.write("".join(PLAIN) + "\udcff\u4e2d")  # of a file name; without an entry
    out.flush()
    shown = out.buffer.getvalue().decode("ascii")  # type: ignore[attr-defined]
    assert shown == "".join(PLAIN.values()) + "??"
