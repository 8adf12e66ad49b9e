"""Two graphics cards of which there are only the random generators."""

import pytest
import torch
from torch import Tensor


class FakeCards:
    """The states of the cards' generators, by their number."""

    def __init__(self) -> None:
        self.states = [torch.full((16,), 7, dtype=torch.uint8) for _ in range(2)]

    def seed(self, seed: int) -> None:
        """What ``torch.manual_seed`` does to cards."""
        self.states = [torch.full((16,), seed % 256, dtype=torch.uint8) for _ in self.states]

    def get(self, device: int | str | torch.device = "cuda") -> Tensor:
        """The state of one of them."""
        return self.states[_number(device)]

    def set(self, state: Tensor, device: int | str | torch.device = "cuda") -> None:
        """Set the state of one of them."""
        self.states[_number(device)] = state


def _number(device: int | str | torch.device) -> int:
    return device if isinstance(device, int) else torch.device(device).index or 0


def fake_cards(monkeypatch: pytest.MonkeyPatch, in_use: bool = True) -> FakeCards:
    """Let torch see two cards, whose generators alone can be used; ``in_use``: CUDA runs already."""
    cards = FakeCards()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: in_use)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: len(cards.states))
    monkeypatch.setattr(torch.cuda, "get_rng_state", cards.get)
    monkeypatch.setattr(torch.cuda, "set_rng_state", cards.set)
    monkeypatch.setattr(torch.cuda, "manual_seed_all", cards.seed)
    return cards
