"""Play episodes and give out their frames, one by one."""

from collections.abc import Iterator

from arcade_torch.envs_jax import ACTION_NAMES
from arcade_torch.gym_window import enlarge
from arcade_torch.tools.play.session import NEXT, QUIT, Frame, Session
from arcade_torch.tools.record.players import Chooser


def recorded_frames(session: Session, chooser: Chooser, *, max_steps: int, hold: int, scale: int) -> Iterator[Frame]:
    """Play a session to its end.

    Args:
        session: what is played; it ends by itself, so it has a number of episodes.
        chooser: who plays.
        max_steps: an episode that is longer is abandoned, and the session with it.
        hold: how often the last picture of an episode is shown.
        scale: width and height of a frame's pixel.

    Yields:
        The first frame of each episode and the one after every step, uint8 [H, W, 3].
    """
    while not session.closed:
        yield enlarge(session.frame, scale)
        if session.end is not None:
            yield from (enlarge(session.frame, scale) for _ in range(hold - 1))
            session.press(NEXT)
        elif session.steps >= max_steps:
            session.press(QUIT)
        else:
            session.press(ACTION_NAMES[chooser.choose(session)])
