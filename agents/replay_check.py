"""One number that is zero only if a recurrent policy reads a batch as it acted it."""

import torch
from tensordict import TensorDictBase, is_tensor_collection, unravel_key
from tensordict.nn import ProbabilisticTensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from arcade_torch.agents.batch_checks import Key, NetworkInputs
from arcade_torch.agents.layout import as_steps
from arcade_torch.models.memory import MASKS, step_mask

__all__ = ["check_replay"]


def check_replay(
    policy: TensorDictModuleBase, batch: TensorDictBase, key: Key | None = None
) -> float:
    """Read a batch again in recurrent mode, and say how far that is from what was acted.

    Call it before the first update, on a batch as the loss gets it: out of the collector, out of
    the replay buffer. Up to rounding the answer is zero; it is large where a state is not carried
    (no primer), steps are shuffled, starts are not marked, or a reset is forgotten, and a loss
    would then learn from a policy that never acted.

    Args:
        policy: any TensorDict policy with or without memory (``MemoryModule``, TorchRL's
            ``LSTMModule`` and ``GRUModule``), as it acted.
        batch: [*, T] of any TorchRL env and collector, or sequences of
            ``ArcadeCollector.collect()``; padding that a ``mask`` leaves out does not count.
        key: the output that is compared; by default the log-probability of the actions where the
            policy has one that the batch holds, or else its ``action_value``.

    Returns:
        The largest absolute difference.

    Raises:
        KeyError: a memory without start flags.
        ValueError: the batch holds no output of the policy that could be compared.

    Example:
        >>> import arcade_torch
        >>> from arcade_torch.agents import make_policy
        >>> from arcade_torch.models import make_network
        >>> env = arcade_torch.make("MineSweeperEasy", num_envs=2)
        >>> policy = make_policy(make_network("small", "gru"))
        >>> batch = arcade_torch.ArcadeCollector(env, policy, 16).collect()
        >>> check_replay(policy, batch) < 1e-4
        True
    """
    inputs = NetworkInputs(policy)
    for flags in inputs.start_keys:
        if "is_init" not in batch and flags in batch:
            batch = batch.copy().set("is_init", batch[flags])
    outputs = [output for output in policy.out_keys if output in batch]
    outputs = [output for output in outputs if unravel_key(output)[0] != "next"]
    name = _compared(policy, outputs, key)
    masks = [mask for mask in MASKS if mask in batch]
    acted = as_steps(batch, inputs, *outputs, *masks)
    read = acted.select(*inputs.observation_keys, *inputs.state_keys, strict=False)

    head = _heads(policy).get(name)
    with torch.no_grad(), set_recurrent_mode(True):
        if head is None:
            replayed = policy(read)[name]
        elif hasattr(policy, "log_prob"):
            # of the actions that were taken: the policy would draw others
            replayed = policy.log_prob(read.update(acted.select(*outputs)))
        else:
            read = policy(read).update(acted.select(*head.dist_sample_keys))
            replayed = head.log_prob(read)
    if is_tensor_collection(replayed):
        replayed = replayed[name]
    return _largest_difference(replayed, acted[name], acted)


def _heads(policy: TensorDictModuleBase) -> dict[Key, ProbabilisticTensorDictModule]:
    """The modules within a policy that draw actions, by where they write log-probabilities."""
    heads = {}
    for module in policy.modules():
        if isinstance(module, ProbabilisticTensorDictModule) and module.return_log_prob:
            for key in module.log_prob_keys:
                heads[unravel_key(key)] = module
    return heads


def _compared(policy: TensorDictModuleBase, outputs: list[Key], key: Key | None) -> Key:
    """Which of the outputs that a batch holds is compared."""
    wanted = [*_heads(policy), "action_value"] if key is None else [unravel_key(key)]
    for name in wanted:
        if name in outputs:
            return name
    raise ValueError(
        f"the batch must hold one of {wanted} as the policy wrote it, got {outputs}: collect with "
        "the policy, with return_log_prob=True where it draws its actions, or name another key"
    )


def _largest_difference(replayed: Tensor, acted: Tensor, steps: TensorDictBase) -> float:
    """The largest absolute difference; equal infinities do not differ."""
    difference = (replayed - acted).detach().abs()  # a rollout may have been made with gradients
    difference = difference.masked_fill(replayed == acted, 0.0)
    mask = step_mask(steps, steps.shape)
    if mask is not None:
        difference = difference[mask]
    return float(difference.max())
