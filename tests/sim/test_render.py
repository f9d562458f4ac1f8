"""Trajectory pictures: complete files, the right colours, errors that name the track."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from sim_pkg.render import Track, TrajectoryPanel, draw_trajectories

GREEN, ORANGE = "#2a9d4a", "#e07b00"
PATH_M = np.array([[(1.5, 7.5), (8.5, 2.5)], [(2.5, 7.5), (8.5, 2.5)], [(3.5, 7.5), (8.5, 2.5)]])


def panel(*tracks: Track) -> TrajectoryPanel:
    return TrajectoryPanel("robot_2 muted", (10.0, 10.0), [(4.5, 7.5), (5.5, 2.5)], tracks)


def count(path: Path, colour: str) -> int:
    """Pixels of a colour."""
    wanted = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)])
    pixels = np.round(imread(path)[:, :, :3] * 255).astype(int)
    return int((np.abs(pixels - wanted).max(axis=-1) <= 2).sum())


def test_overlapping_tracks_stay_visible(tmp_path: Path) -> None:
    path = tmp_path / "new" / "picture.png"
    green, orange = Track("QMIX", GREEN, PATH_M, (1,)), Track("coached", ORANGE, PATH_M, (1,))
    draw_trajectories([panel(green)], path)
    alone, width = count(path, GREEN), imread(path).shape[1]
    assert alone > 300
    assert count(path, ORANGE) == 0
    draw_trajectories([panel(green, orange)], path)
    assert count(path, GREEN) > 0.6 * alone
    assert count(path, ORANGE) > 0.6 * alone
    draw_trajectories([panel(green), panel(orange)], path)
    assert imread(path).shape[1] == 2 * width
    assert [p.name for p in path.parent.iterdir()] == ["picture.png"]


def test_a_crashed_robot_is_dotted(tmp_path: Path) -> None:
    still = np.repeat(PATH_M[:1], 2, axis=0)
    draw_trajectories([panel(Track("a", GREEN, still, ()))], tmp_path / "solid.png")
    draw_trajectories([panel(Track("a", GREEN, still, (0, 1)))], tmp_path / "dotted.png")
    arena = (slice(120, 700), slice(0, None))
    solid, dotted = (imread(tmp_path / f"{n}.png")[arena][..., :3] for n in ("solid", "dotted"))
    assert 0.5 < (dotted < 0.4).all(-1).sum() / (solid < 0.4).all(-1).sum() < 0.98


def test_wrong_input_is_refused_and_nothing_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no panel"):
        draw_trajectories([], tmp_path / "x.png")
    flat = Track("QMIX", GREEN, PATH_M[:, 0])
    with pytest.raises(ValueError, match=r"'QMIX' of panel 'robot_2 muted'.*\(3, 2\)"):
        draw_trajectories([panel(flat)], tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []
