"""An episode of somebody else's environment as the pictures that it draws of itself."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from crash_coach_common.contract import BoolArray, IntArray
from crash_coach_common.whole_output import whole_output
from sim_pkg.foreign.env import ForeignEnv

Picture = npt.NDArray[np.uint8]

_HEADER_PX = 32
_FONT_PX = 17
_INK, _PAPER = (51, 51, 51), (255, 255, 255)
_STILLS = 4  # pictures of a still, from the first to the last
_GAP_PX = 8
_LEAST_WIDTH_PX = 480


@dataclass(frozen=True)
class Pictures:
    """One episode of T steps: the environment's own pictures before the first and after each step.

    ``packed``: (T+1,) the pictures' bytes, compressed; all have one ``shape`` (H, W, 3).
    """

    scenario: str
    seed: int
    episode: int
    dt_s: float
    robots: tuple[str, ...]
    shape: tuple[int, ...]
    packed: Sequence[bytes]
    crashed: BoolArray  # (T, n) robots whose command a fault replaced
    returns: npt.NDArray[np.float64]  # (T+1,) sum of the rewards so far
    success: bool | None  # None: the environment does not tell
    trajectory_hash: str

    @property
    def steps(self) -> int:
        return len(self.crashed)

    @property
    def faulted(self) -> tuple[int, ...]:
        """Robots that were crashed in any step."""
        return tuple(np.flatnonzero(self.crashed.any(axis=0)).tolist())

    def picture(self, step: int) -> Picture:
        """(H, W, 3)"""
        return np.frombuffer(zlib.decompress(self.packed[step]), np.uint8).reshape(self.shape)


class PictureRecorder:
    """Gathers the Pictures of one arena's running episode; to be made right after its reset."""

    def __init__(self, env: ForeignEnv, arena: int, seed: int, episode: int) -> None:
        self._env, self._arena, self._key = env, arena, (seed, episode)
        self._shape: tuple[int, ...] = ()
        self._packed: list[bytes] = []
        self._crashed: list[BoolArray] = []
        self._returns = [0.0]
        self._look()

    def step(
        self, intents: IntArray, actions: IntArray, faults: npt.NDArray[np.uint8], reward: float
    ) -> None:
        """After a control step. (n,) wanted and executed actions, and codes of faults in force."""
        self._crashed.append(faults != 0)
        self._returns.append(self._returns[-1] + reward)
        self._look()

    def finish(self, success: bool, trajectory_hash: str) -> Pictures:
        """What was gathered, when the episode has ended."""
        spec, (seed, episode) = self._env.spec, self._key
        return Pictures(
            scenario=spec.scenario,
            seed=seed,
            episode=episode,
            dt_s=spec.dt_s,
            robots=spec.robots,
            shape=self._shape,
            packed=tuple(self._packed),
            crashed=np.stack(self._crashed),
            returns=np.array(self._returns),
            success=success if spec.reports_success else None,
            trajectory_hash=trajectory_hash,
        )

    def _look(self) -> None:
        picture = self._env.picture(self._arena)
        self._shape = self._shape or picture.shape
        if picture.shape != self._shape:
            raise ValueError(f"a picture of {picture.shape} after pictures of {self._shape}")
        self._packed.append(zlib.compress(picture.tobytes(), 1))


class PictureFilm:
    """The pictures with a line above them that says the step, the return and who is crashed."""

    def __init__(self, pictures: Pictures) -> None:
        self._pictures = pictures
        height, width = pictures.shape[:2]
        scale = -(-_LEAST_WIDTH_PX // width)  # so that the line fits
        self._inner = (scale * width, scale * height)
        width, height = self._inner
        self._size = (width + width % 2, height + _HEADER_PX + height % 2)
        self._font = ImageFont.load_default(_FONT_PX)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels, both even."""
        return self._size

    def picture(self, at: float) -> Picture:
        """(H, W, 3) at a time in control steps."""
        step = min(int(at), self._pictures.steps)
        sheet = Image.new("RGB", self._size, _PAPER)
        picture = Image.fromarray(self._pictures.picture(step))
        sheet.paste(picture.resize(self._inner, Image.Resampling.NEAREST), (0, _HEADER_PX))
        ImageDraw.Draw(sheet).text((8, 6), self._title(step), fill=_INK, font=self._font)
        return np.asarray(sheet)

    def _title(self, step: int) -> str:
        told = self._pictures
        parts = [f"step {step}", f"return {told.returns[step]:.2f}"]
        down = told.crashed[min(step, told.steps - 1)]
        names = [robot for robot, is_down in zip(told.robots, down, strict=True) if is_down]
        if names:
            parts.append(f"crashed: {', '.join(names)}")
        if step == told.steps and told.success is not None:
            parts.append("success" if told.success else "no success")
        return "   ".join(parts)


def write_still(pictures: Pictures, path: Path) -> None:
    """Writes ``path``, a .png: the episode's beginning, two moments between, and its end.

    Raises:
        OSError: the file cannot be written.
    """
    film = PictureFilm(pictures)
    steps = np.unique(np.linspace(0, pictures.steps, _STILLS).astype(int))
    width, height = film.size
    sheet = Image.new("RGB", (len(steps) * (width + _GAP_PX) - _GAP_PX, height), _PAPER)
    for k, step in enumerate(steps.tolist()):
        sheet.paste(Image.fromarray(film.picture(step)), (k * (width + _GAP_PX), 0))
    with whole_output(path) as temporary:
        sheet.save(temporary, format="PNG")
