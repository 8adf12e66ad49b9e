"""Saliency of an agent's last decision in one greedy episode."""

from typing import Any

from arcade_torch.tools.analysis.pixel_saliency import Norm, Reduce, Saliency, Target, saliency
from arcade_torch.tools.analysis.subject import Twin, own_env
from arcade_torch.tools.analysis.windows import MAX_STEPS, Window, greedy_window


def episode_window(
    agent: Any, *, seed: int = 0, observability: Twin | None = None, max_steps: int = MAX_STEPS
) -> Window:
    """Play one greedy episode in the agent's own game.

    Args:
        agent: from `arcade_torch.agents.load`.
        seed: evaluation seed of the episode; training never sees it.
        observability: ``full`` or ``partial``; as trained by default.
        max_steps: longest episode.

    Returns:
        What the agent saw, up to the decision that ended the episode.
    """
    from arcade_torch.agents.evaluation import held_out_seed

    env = own_env(agent, 1, observability, seed)
    return greedy_window(agent, env, seed=held_out_seed(seed), max_steps=max_steps)


def explain(
    agent: Any, window: Window, *, reduce: Reduce = "per_action", norm: Norm = "l2sq", target: Target = "auto"
) -> Saliency:
    """Saliency of the last decision of a window; options as in `saliency`."""
    return saliency(
        agent, window.frames, window.last_action, window.is_init, window.state, reduce=reduce, norm=norm, target=target
    )
