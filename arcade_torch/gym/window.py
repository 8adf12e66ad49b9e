"""A window that shows frames, enlarged to whole pixels; needs pygame, which the extra ``play``
brings.
"""

import weakref
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt


class Window:
    """One window of pygame, opened by the first frame; ``scale`` is the side of a frame's pixel on
    the screen.

    pygame has one window a process, so a second one is refused until the first is closed.
    """

    _shown: ClassVar[Callable[[], "Window | None"]] = lambda: None  # the one that is open

    def __init__(self, scale: int = 1) -> None:
        try:
            import pygame
        except ModuleNotFoundError as error:
            raise ImportError("a window needs the package pygame: pip install '.[play]'") from error
        self.pygame: Any = pygame
        self._scale = scale
        self._screen: Any = None
        self._clock: Any = None

    def __reduce__(self) -> tuple[Any, ...]:
        """A copy is a window that has not been opened."""
        return Window, (self._scale,)

    def show(self, frame: npt.NDArray[np.uint8], title: str) -> None:
        """Show a frame, uint8 [H, W, 3], under a title."""
        pygame = self.pygame
        height = frame.shape[0] * self._scale
        width = frame.shape[1] * self._scale
        if self._screen is None:
            if Window._shown() is not None:
                raise RuntimeError(
                    "pygame shows one window a process: close() the env that has it first"
                )
            pygame.display.init()
            Window._shown = weakref.ref(self)
            self._screen = pygame.display.set_mode((width, height))
            self._clock = pygame.time.Clock()
        pygame.display.set_caption(title)
        pygame.surfarray.blit_array(self._screen, enlarge(frame, self._scale).swapaxes(0, 1))
        pygame.display.flip()

    def tick(self, fps: float) -> None:
        """Wait so that this is reached at most ``fps`` times a second, and answer the window
        system.
        """
        if self._clock is not None:
            self.pygame.event.pump()
            self._clock.tick(fps)

    def close(self) -> None:
        """Close the window; closing it again does nothing."""
        if self._screen is not None:
            self.pygame.display.quit()
            self._screen = None
            Window._shown = lambda: None


def enlarge(frame: npt.NDArray[np.uint8], scale: int) -> npt.NDArray[np.uint8]:
    """Repeat every pixel ``scale`` times in both directions.

    Example:
        >>> enlarge(np.zeros((2, 3, 3), np.uint8), 4).shape
        (8, 12, 3)
    """
    return frame.repeat(scale, axis=0).repeat(scale, axis=1)
