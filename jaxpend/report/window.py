"""A window that shows one picture after the other, where there is a display."""

import time
from typing import Any

import numpy as np

from ..errors import JaxpendError

__all__ = ["Window"]


class Window:
    """A window of matplotlib. Raises ``JaxpendError`` where there is no display to open one on."""

    def __init__(self, title: str):
        from matplotlib import pyplot

        try:
            self._figure = pyplot.figure(num=title, figsize=(4, 4), clear=True)
        except ImportError:  # a backend was chosen that cannot work here
            raise _no_display(pyplot.get_backend()) from None
        if self._figure.canvas.required_interactive_framework is None:
            pyplot.close(self._figure)
            raise _no_display(pyplot.get_backend())
        self._picture: Any = None
        self._shown = -np.inf

    def show(self, picture: np.ndarray, period: float) -> None:
        """Show a picture (height, width, 3), uint8, ``period`` s after the last one or later.

        Nothing happens once its reader has closed the window.
        """
        from matplotlib import pyplot

        if not pyplot.fignum_exists(self._figure.number):
            return
        canvas = self._figure.canvas
        if self._picture is None:
            axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0))
            axes.axis("off")
            self._picture = axes.imshow(picture)
            if canvas.manager is not None:
                canvas.manager.show()
        self._picture.set_data(picture)
        canvas.draw_idle()
        # The window lives only while its events are looked at.
        canvas.start_event_loop(max(self._shown + period - time.monotonic(), 0.001))
        self._shown = time.monotonic()

    def close(self) -> None:
        """Close it; it may be closed already."""
        from matplotlib import pyplot

        pyplot.close(self._figure)


def _no_display(backend: str) -> JaxpendError:
    text = f"matplotlib's backend {backend} has no windows here"
    return JaxpendError(f'{text}; use render_mode "rgb_array", or a machine with a display')
