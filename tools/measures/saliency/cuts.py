"""Gradients that say nothing: those that are no numbers, and zeros that are no truth but a cut. A
policy that detaches its state, or runs a part of it without gradients, depends on what autograd
says nothing of.
"""

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

from arcade_torch.tools.measures.masked import differences

NUDGE = 1e-2  # how far inputs are moved, of their mean size
CHANGED = 1e-5  # of the outputs: more than rounding changes them


@torch.no_grad()
def refuse_cuts(outputs_of: Callable[[Tensor], Tensor], inputs: Tensor, reached: Tensor) -> None:
    """Refuse outputs that change with inputs by which they have no gradient.

    Those inputs are all raised a little, and all lowered: at a kink, such as the largest of equal
    numbers, where a gradient of zero is right, one of the two changes nothing.

    Args:
        outputs_of: the outputs that follow from inputs.
        inputs: [T, ...], of T frames.
        reached: bool [T], the frames by which the outputs have a gradient.

    Raises:
        ValueError: the gradient is cut.
    """
    if reached.all():
        return
    inputs = inputs.detach()
    generator = torch.Generator("cpu").manual_seed(0)
    nudge = torch.rand(inputs.shape, generator=generator, dtype=torch.float32, device="cpu")
    nudge = nudge.to(inputs) * inputs.abs().mean() * NUDGE
    nudge[reached] = 0
    values = outputs_of(inputs)
    size = values.nan_to_num(posinf=0.0, neginf=0.0).abs().max()
    raised = differences(outputs_of(inputs + nudge), values).max()
    lowered = differences(outputs_of(inputs - nudge), values).max()
    if torch.minimum(raised, lowered) > CHANGED * size:
        raise ValueError(
            f"the outputs change with {int((~reached).sum())} of {len(inputs)} frames by which they"
            " have no gradient: the policy detaches something, or runs a part under "
            "torch.no_grad(); let gradients through, or measure counterfactual recall, which needs "
            "none"
        )


def refuse_infinite(norms: Tensor) -> None:
    """Refuse gradients that are NaN or infinite, by their norms.

    Raises:
        ValueError: one of them is.
    """
    if not norms.isfinite().all():
        count = int((~norms.isfinite()).sum())
        raise ValueError(
            f"gradients must be numbers, got NaN or infinity for {count} of {len(norms)} frames: "
            "the policy takes log(0), sqrt(0) or the like; or measure counterfactual recall, which "
            "needs no gradient"
        )


def outside_inference(values: Any) -> Any:
    """The same tensor or TensorDict, as autograd can use it: a copy if it was made in inference
    mode.
    """
    if isinstance(values, TensorDictBase):
        return values.apply(outside_inference)
    return values.clone() if isinstance(values, Tensor) and values.is_inference() else values
