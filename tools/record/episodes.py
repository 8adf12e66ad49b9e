"""Play episodes and give out their frames, one by one."""

from collections.abc import Iterator

from arcade_torch.envs_jax import ACTION_NAMES
from arcade_torch.gym.window import enlarge
from arcade_torch.tools.play.session import NEXT, QUIT, Frame, Session
from arcade_torch.tools.record.players import Chooser


def recorded_frames(session: Session, chooser: Chooser, *, max_steps: int, hold: int, scale: int) -> Iterator[Frame]:
    """Play a session to its end."""
    while not session.closed:
        yield enlarge(session.frame, scale)
        if session.end is not None:
            yield from (enlarge(session.frame, scale) for _ in range(hold - 1))
            session.press(NEXT)
        elif session.steps >= max_steps:
            session.press(QUIT)
        else:
            session.press(ACTION_NAMES[chooser.choose(session)])
