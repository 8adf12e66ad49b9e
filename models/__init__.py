"""Memory models in torch: cells, networks around them, and their place in TorchRL.

A memory model is an ``nn.Module`` with two methods: ``forward(x [B, T, D], state, is_init [B, T])
-> (y [B, T, H], state)`` and ``initial_state(batch_size)``. Acting is the same call with T = 1; the
state is a TensorDict of fixed-shape tensors; ``is_init`` marks the steps that open an episode,
before which everything is forgotten.

* :func:`make_memory`, :func:`memory_names`, :func:`register_memory`: models by name (``lru mingru
  gru mlp linear_transformer attention gdn ttt lstm frame_stack s5 mamba slstm mlstm gtrxl ffm shm
  rtu deltaproduct rwkv7 bmru``).
* :class:`RecurrentMemory`: a recurrent module of any library, such as ``torch.nn.LSTM``, as such a
  model.
* :func:`check_memory`: check that a module, ours or yours, is a correct memory model;
  :class:`MemoryLawError` says what is wrong with it, :func:`law_results` checks on behind it.
* :class:`MemoryModule`: any of them behind TorchRL's recurrent contract, in place of
  ``LSTMModule``.
* :func:`make_network`, :class:`MemoryNetwork`: pixels to Q-values, presets "paper" and "small".
* :func:`make_actor_critic`, :class:`ActorCriticNetwork`: pixels to logits and a value, by two
  networks ("paper") or by one for both ("small"). All these networks are TensorDict modules.
* :class:`MemoryBlock`: the stack of cells between encoder and head.
* :func:`linear_scan`: the recurrence h_t = a_t h_{t-1} + b_t as a torch operator;
  :func:`matrix_scan`: the delta rule S_t = alpha_t (I - beta_t k_t k_t^T) S_{t-1} + k_t v_t^T in
  chunks.

Nothing here knows an environment or JAX. TorchRL is imported only when a TensorDict module runs or
makes its primer.

Example:
    >>> import torch
    >>> memory = make_memory("lru", input_size=8, hidden_size=16)
    >>> x, is_init = torch.randn(4, 10, 8), torch.zeros(4, 10, dtype=torch.bool)
    >>> y, state = memory(x, memory.initial_state(4), is_init)
    >>> y.shape
    torch.Size([4, 10, 16])
"""

from arcade_torch.models.actor_critic import ActorCriticNetwork, make_actor_critic
from arcade_torch.models.checks import LawResult, MemoryLawError, check_memory, law_results
from arcade_torch.models.encoders import Encoder, PaperEncoder, SmallEncoder
from arcade_torch.models.memory import Memory, MemoryContract, ReplayableMemory
from arcade_torch.models.memory_module import MemoryModule
from arcade_torch.models.networks import MemoryBlock, MemoryNetwork
from arcade_torch.models.presets import make_network
from arcade_torch.models.recurrent_memory import RecurrentMemory
from arcade_torch.models.registry import make_memory, memory_names, register_memory
from arcade_torch.models.scan import linear_scan
from arcade_torch.models.scan_matrix import MatrixSteps, matrix_scan, matrix_scan_loop

__all__ = [
    "ActorCriticNetwork",
    "Encoder",
    "LawResult",
    "MatrixSteps",
    "Memory",
    "MemoryBlock",
    "MemoryContract",
    "MemoryLawError",
    "MemoryModule",
    "MemoryNetwork",
    "PaperEncoder",
    "RecurrentMemory",
    "ReplayableMemory",
    "SmallEncoder",
    "check_memory",
    "law_results",
    "linear_scan",
    "make_actor_critic",
    "make_memory",
    "make_network",
    "matrix_scan",
    "matrix_scan_loop",
    "memory_names",
    "register_memory",
]
