"""A session in a window of pygame."""

import os
import sys

from arcade_torch.gym.window import Window
from arcade_torch.tools.optional import MissingPackage, need
from arcade_torch.tools.play.session import NEXT, QUIT, RESTART, TOGGLE, Session

FPS = 30
_DELAY_MS = 300  # how long a key is held before it repeats
_KEYS = {"K_UP": "up", "K_DOWN": "down", "K_LEFT": "left", "K_RIGHT": "right", "K_SPACE": "fire"}
_KEYS |= {"K_r": RESTART, "K_p": TOGGLE, "K_RETURN": NEXT, "K_ESCAPE": QUIT}


def why_no_window() -> str | None:
    """Why a window cannot be opened here, in a few words; None if it can."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        pygame = need("pygame")
    except MissingPackage as error:
        return str(error)
    names = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in names):
        return "there is no display"
    try:
        pygame.display.init()
    except pygame.error as error:
        return f"no display can be opened ({error})"
    return None


def play_in_window(session: Session, scale: int = 2, key_repeat_ms: int = 0) -> None:
    """Show a session and hand it the keys, until it is closed."""
    window = Window(scale)
    pygame = window.pygame
    keys = {getattr(pygame, constant): name for constant, name in _KEYS.items()}
    try:
        window.show(session.frame, session.caption)
        pygame.key.set_repeat(*((_DELAY_MS, key_repeat_ms) if key_repeat_ms else ()))
        while not session.closed:
            for event in pygame.event.get((pygame.QUIT, pygame.KEYDOWN)):
                key = QUIT if event.type == pygame.QUIT else keys.get(event.key)
                if key is not None:
                    session.press(key)
                    window.show(session.frame, session.caption)
            window.tick(FPS)
    finally:
        window.close()
