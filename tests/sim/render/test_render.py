"""Pictures and films: complete files, the right colours, errors that name what is wrong."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from PIL import Image, ImageSequence

from sim_pkg.render.comparison import Panel, Track, draw_trajectories
from sim_pkg.render.film import GIF_FPS, LAST_S, MP4_FPS, write_video
from sim_pkg.render.frames import Actor, Frames, Side
from sim_pkg.render.stage import CRASHED, HEALTH, HIT, SHIELD, SIDE_COLOURS
from sim_pkg.render.still import draw_still
from sim_pkg.scenarios.base import Scene

GREEN, ORANGE = "#2a9d4a", "#e07b00"
PATH_M = np.array([[(1.5, 7.5), (8.5, 2.5)], [(2.5, 7.5), (8.5, 2.5)], [(3.5, 7.5), (8.5, 2.5)]])
SITES_M = ((4.5, 7.5), (5.5, 2.5))


def frames(path_m: np.ndarray = PATH_M, crashed: tuple[int, ...] = ()) -> Frames:
    """Two robots on a grid, without opponents."""
    steps, n = path_m.shape[0] - 1, path_m.shape[1]
    radii = (0.4,) * n
    faults = np.zeros((steps, n), dtype=np.uint8)
    faults[:, list(crashed)] = 1
    return Frames(
        scenario="buttons", seed=0, episode=3, dt_s=1.0,
        scene=Scene((10.0, 10.0), 1.0, radii, SITES_M), walled_m=(0.0, 0.0, 10.0, 10.0),
        actors=tuple(Actor(f"robot_{i + 1}", "robot", Side.ROBOTS, 0.4) for i in range(n)),
        positions_m=path_m.astype(np.float32), angles_rad=np.zeros((steps + 1, n), np.float32),
        health=np.ones((steps + 1, n), np.float32), shield=np.zeros((steps + 1, n), np.float32),
        damage=np.zeros((steps, n, n), np.float32),
        sites_done=np.zeros((steps + 1, 2), np.bool_),
        intents=np.zeros((steps, n), np.int32), actions=np.zeros((steps, n), np.int32),
        faults=faults,
        returns=np.arange(steps + 1, dtype=np.float64), success=True, trajectory_hash="ab",
    )  # fmt: skip


def fight() -> Frames:
    """A robot in the middle of a large arena, hit once by the opponent that then dies."""
    path_m = np.array([[(15.0, 16.0), (17.0, 16.0)]] * 3)
    actors = (
        Actor("robot_1", "marine", Side.ROBOTS, 0.4),
        Actor("opponent_1", "zealot", Side.OPPONENTS, 0.5),
    )
    damage = np.zeros((2, 2, 2), np.float32)
    damage[0, 1, 0], damage[1, 0, 1] = 20.0, 200.0
    return replace(
        frames(path_m),
        damage=damage,
        scene=Scene((32.0, 32.0), 0.0, (0.4,), ()),
        walled_m=(0.0, 7.0, 32.0, 24.0),
        actors=actors,
        health=np.array([(1, 1), (1, 1), (1, 0)], np.float32),
        shield=np.array([(1, 1), (0.5, 1), (0.5, 0)], np.float32),
        sites_done=np.zeros((3, 0), np.bool_),
        faults=np.zeros((2, 1), np.uint8),
        intents=np.zeros((2, 1), np.int32),
        actions=np.zeros((2, 1), np.int32),
    )


def panel(*tracks: Track) -> Panel:
    return Panel("robot_2 muted", tracks)


def pixels(picture: np.ndarray, colour: str, tolerance: int = 2) -> int:
    """How many pixels of an (H, W, 3) picture of bytes have a colour."""
    wanted = np.round(255 * np.array(to_rgb(colour)))
    near = np.abs(picture.astype(int) - wanted).max(axis=-1) <= tolerance
    return int(near.sum())


def png(path: Path) -> np.ndarray:
    return np.round(imread(path)[:, :, :3] * 255)


def film(path: Path) -> list[np.ndarray]:
    """The pictures of an MP4, decoded."""
    reader = imageio_ffmpeg.read_frames(str(path))
    width, height = next(reader)["size"]
    return [np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in reader]


def test_overlapping_tracks_stay_visible(tmp_path: Path) -> None:
    path = tmp_path / "new" / "picture.png"
    green, orange = (
        Track(*team, frames(crashed=(1,))) for team in (("QMIX", GREEN), ("coached", ORANGE))
    )
    draw_trajectories([panel(green)], path)
    alone, width = pixels(png(path), GREEN), imread(path).shape[1]
    assert alone > 300
    assert pixels(png(path), ORANGE) == 0
    draw_trajectories([panel(green, orange)], path)
    assert pixels(png(path), GREEN) > 0.6 * alone
    assert pixels(png(path), ORANGE) > 0.6 * alone
    draw_trajectories([panel(green), panel(orange)], path)
    assert imread(path).shape[1] == 2 * width
    assert [p.name for p in path.parent.iterdir()] == ["picture.png"]


def test_a_crashed_robot_is_dotted(tmp_path: Path) -> None:
    still = np.repeat(PATH_M[:1], 2, axis=0)
    draw_trajectories([panel(Track("a", GREEN, frames(still)))], tmp_path / "solid.png")
    draw_trajectories([panel(Track("a", GREEN, frames(still, (0, 1))))], tmp_path / "dotted.png")
    arena = (slice(120, 700), slice(0, None))
    solid, dotted = (imread(tmp_path / f"{n}.png")[arena][..., :3] for n in ("solid", "dotted"))
    assert 0.5 < (dotted < 0.4).all(-1).sum() / (solid < 0.4).all(-1).sum() < 0.98


def test_wrong_input_is_refused_and_nothing_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no panel"):
        draw_trajectories([], tmp_path / "x.png")
    other = replace(frames(), scenario="elsewhere")
    with pytest.raises(ValueError, match=r"'robot_2 muted'.*buttons.*elsewhere"):
        draw_trajectories(
            [panel(Track("a", GREEN, frames()), Track("b", ORANGE, other))], tmp_path / "x.png"
        )
    with pytest.raises(ValueError, match=r"x\.avi: a film is"):
        write_video(frames(), tmp_path / "x.avi")
    with pytest.raises(ValueError, match="speed = 0"):
        write_video(frames(), tmp_path / "x.mp4", speed=0)
    assert list(tmp_path.iterdir()) == []


def test_a_still_shows_ways_and_who_crashed(tmp_path: Path) -> None:
    path = tmp_path / "still.png"
    draw_still(frames(), path)
    way = pixels(png(path), "#0072B2")
    assert way > 3000  # the end of robot_1's way is a full disc
    assert pixels(png(path), CRASHED) < 300  # smooth edges of text
    draw_still(frames(crashed=(1,)), path)
    assert pixels(png(path), CRASHED) > 3000
    assert [p.name for p in tmp_path.iterdir()] == ["still.png"]


def test_a_still_zooms_into_a_fight_and_marks_the_dead(tmp_path: Path) -> None:
    draw_still(fight(), tmp_path / "fight.png")
    alive = replace(fight(), health=np.ones((3, 2), np.float32))
    draw_still(alive, tmp_path / "alive.png")
    opponent = SIDE_COLOURS[Side.OPPONENTS]
    dead, all_alive = (pixels(png(tmp_path / f"{n}.png"), opponent) for n in ("fight", "alive"))
    assert dead > all_alive + 100  # a cross
    wide = replace(fight(), positions_m=fight().positions_m + np.float32([(0, 0), (14, 0)]))
    draw_still(wide, tmp_path / "wide.png")
    assert pixels(png(tmp_path / "wide.png"), opponent) < 0.7 * dead  # all is smaller


def test_an_mp4_shows_every_step_at_its_time(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    write_video(frames(crashed=(1,)), path)
    pictures = film(path)
    assert len(pictures) == pytest.approx((2 + LAST_S) * MP4_FPS, abs=2)
    blue, near = SIDE_COLOURS[Side.ROBOTS], 12  # H.264 changes colours a little
    assert pixels(pictures[0], blue, near) > 1000
    assert pixels(pictures[0], CRASHED, near) > 1000
    columns = [np.flatnonzero((np.abs(p.astype(int) - (0, 114, 178)).max(-1) < near).any(0))
               for p in (pictures[0][60:-60], pictures[-1][60:-60])]  # fmt: skip
    cell = pictures[0].shape[1] / 10
    assert columns[1].max() - columns[0].max() == pytest.approx(2 * cell, rel=0.1)
    write_video(frames(crashed=(1,)), tmp_path / "fast.mp4", speed=2.0)
    assert len(film(tmp_path / "fast.mp4")) == pytest.approx((1 + LAST_S) * MP4_FPS, abs=2)


def test_a_film_shows_health_shield_hits_and_the_dead(tmp_path: Path) -> None:
    path = tmp_path / "fight.mp4"
    write_video(fight(), path)
    first, second, last = (film(path)[k] for k in (MP4_FPS // 2, 3 * MP4_FPS // 2, -1))
    legend = pixels(last, HIT, 20)  # there everywhere
    assert pixels(first, HIT, 20) > legend + 200
    assert pixels(second, SHIELD, 20) < pixels(first, SHIELD, 20)
    assert pixels(last, HEALTH, 20) < 0.75 * pixels(first, HEALTH, 20)
    opponent = SIDE_COLOURS[Side.OPPONENTS]
    assert pixels(last, opponent, 20) < 0.5 * pixels(first, opponent, 20)


def test_a_gif_has_the_same_times(tmp_path: Path) -> None:
    path = tmp_path / "film.gif"
    write_video(frames(), path)
    with Image.open(path) as image:
        shown_ms = sum(frame.info["duration"] for frame in ImageSequence.Iterator(image))
    assert shown_ms / 1000 == pytest.approx(2 + LAST_S, abs=2 / GIF_FPS)


@pytest.mark.soak
def test_the_same_episode_gives_the_same_file(tmp_path: Path) -> None:
    for name in ("a.mp4", "b.mp4", "a.gif", "b.gif", "a.png", "b.png"):
        path = tmp_path / name
        (draw_still if path.suffix == ".png" else write_video)(fight(), path)
    for kind in ("mp4", "gif", "png"):
        a, b = ((tmp_path / f"{n}.{kind}").read_bytes() for n in "ab")
        assert a == b


def test_a_file_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "taken.png").mkdir()
    with pytest.raises(OSError, match="taken"):
        draw_still(frames(), tmp_path / "taken.png")
    assert [p.name for p in tmp_path.iterdir()] == ["taken.png"]


def test_drawing_needs_no_display() -> None:
    code = "import matplotlib, sim_pkg.render.still, sim_pkg.render.film, sys; "
    code += "sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run(["python", "-c", code], timeout=250).returncode == 0
