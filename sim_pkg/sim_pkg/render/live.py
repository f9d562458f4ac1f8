"""One arena as it is now: pictures of an episode under way, and a window that shows them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from crash_coach_common.contract import IntArray, UserError
from sim_pkg.env import Env
from sim_pkg.foreign.pictures import Picture
from sim_pkg.render.film import EpisodeFilm
from sim_pkg.render.frames import Recorder, walled_m


class LiveFilm:
    """Arena 0 of ``env`` within its walls, at one scale; to be made right after a reset."""

    def __init__(self, env: Env, seed: int, episode: int) -> None:
        self._recorder = Recorder(env, 0, seed, episode)
        self._return, self._steps = 0.0, 0
        self._dt_s = env.spec.dt_s
        self._film = EpisodeFilm(self._recorder.so_far(), view=walled_m(env))

    def step(self, actions: IntArray, crashed: npt.NDArray[np.bool_], reward: float) -> None:
        """After a control step: (n,) executed actions, (n,) robots that a fault was in force on."""
        self._recorder.step(np.full(len(actions), -1), actions, crashed.astype(np.uint8), reward)
        self._return += reward
        self._steps += 1

    def picture(self) -> Picture:
        """(H, W, 3) uint8."""
        clock = f"step {self._steps}, {self._steps * self._dt_s:.1f} s, return {self._return:.2f}"
        return self._film.latest(self._recorder.so_far(), clock)


class Window:
    """A window of this process.

    Raises:
        UserError: there is no display, or Python was built without Tk.
    """

    def __init__(self, title: str) -> None:
        try:
            import tkinter
        except ImportError as error:
            raise UserError(
                "render_mode 'human' needs Tk: install it (on Debian and Ubuntu: python3-tk), or "
                "take 'rgb_array'"
            ) from error
        try:
            self._root = tkinter.Tk()
        except tkinter.TclError as error:
            raise UserError(
                f"render_mode 'human' needs a display ({error}): take 'rgb_array'"
            ) from None
        self._root.title(title)
        self._label = tkinter.Label(self._root, borderwidth=0)
        self._label.pack()
        self._image: Any = None  # Tk itself keeps none

    def show(self, picture: Picture) -> None:
        """Replaces what is shown; does nothing after the user has closed the window."""
        import tkinter

        from PIL import Image, ImageTk

        try:
            self._image = ImageTk.PhotoImage(Image.fromarray(picture), master=self._root)
            self._label.configure(image=self._image)
            self._root.update()
        except tkinter.TclError:
            self._image = None

    def close(self) -> None:
        import tkinter
        from contextlib import suppress

        with suppress(tkinter.TclError):  # closed by the user already
            self._root.destroy()
