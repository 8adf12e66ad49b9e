"""Decisions of a policy, and whether it chooses the best of its outputs, as measures of decisions
take for granted.
"""

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from arcade_torch.tools.measures.masked import refuse_nan
from arcade_torch.tools.measures.policy import HALF_ROUNDING, ROUNDING, as_policy

if TYPE_CHECKING:
    from arcade_torch.tools.measures.windows import Window


def decide(player: Any, obs: Any, state: Any) -> tuple[Tensor, Any]:
    """Greedy actions int64 [N] of a `Policy`, or of what acts as an agent does, and the next state.

    Raises:
        ValueError: it decides by outputs that are no numbers.
    """
    action, extras, state = player.act(obs, state)
    for name in ("q_value", "logits"):
        if name in extras:
            refuse_nan(extras[name])
    return action, state


@torch.no_grad()
def check_choices(agent: Any, window: "Window") -> None:
    """Refuse an agent that did not choose the best of its outputs in an episode that it played.

    Raises:
        ValueError: it did not, or it cannot be replayed.
    """
    # imported here: who measures windows of their own needs no environment
    from arcade_torch.agents.policy import Agent

    policy = as_policy(agent)
    offered = [name for name in ("q", "logits", "probs") if name in policy.offers]
    acts_by_itself = policy.step is not None or agent is not policy
    if isinstance(agent, Agent) or not acts_by_itself or not offered:
        return
    policy.check(window.frames, window.last_action, window.is_init, window.state)
    state = None if window.state is None else window.state.clone()
    with policy.evaluating():
        features = policy.features(window.frames)[None]
    actions = window.last_action[None]
    outputs, _ = policy.unroll(features, actions, window.is_init[None], state, target=offered[0])
    refuse_other_choices(outputs[0], window.action)


def refuse_other_choices(values: Tensor, action: Tensor) -> None:
    """Refuse actions int64 [T] that are not the best of outputs [T, A], up to rounding.

    Raises:
        ValueError: one of them is not.
    """
    action = action.to(values.device)
    is_output = action < values.shape[-1]
    chosen = values.gather(-1, action.where(is_output, 0)[:, None])[:, 0]
    best = values.max(-1)
    size = values.nan_to_num(0.0, 0.0, 0.0).abs().amax(-1)
    rounding = ROUNDING if values.dtype.itemsize > 2 else HALF_ROUNDING
    is_other = ~is_output | (best.values - chosen > rounding * size)
    if not bool(is_other.any()):
        return
    step = int(is_other.nonzero()[0])
    number = f"{float(chosen[step]):.4g}" if is_output[step] else "none"
    raise ValueError(
        f"the policy must choose the best of its outputs, got action {int(action[step])} of value "
        f"{number} where action {int(best.indices[step])} has {float(best.values[step]):.4g}: name "
        "what it chooses by with output_key and output_kind, write a mask into that as -inf, and "
        "draw nothing at random"
    )
