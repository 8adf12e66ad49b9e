"""Torch's generators come back as they were, those of cards too."""

import pytest
import torch

from arcade_torch.models import check_memory, make_memory
from arcade_torch.models.generators import kept_generators
from tests.fake_cards import fake_cards


@pytest.mark.parametrize("in_use", [True, False])
def test_checking_a_memory_leaves_the_generators_of_cards(
    in_use: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A card that is first used later begins with the user's own ``torch.manual_seed``."""
    cards = fake_cards(monkeypatch, in_use)
    torch.manual_seed(5)
    check_memory(make_memory("mingru", 3, 4))
    assert all(bool((state == 5).all()) for state in cards.states)


def test_a_seed_counts_on_the_cards_in_use(monkeypatch: pytest.MonkeyPatch) -> None:
    cards = fake_cards(monkeypatch)
    with pytest.raises(ZeroDivisionError), kept_generators(seed=9):
        assert bool((cards.states[1] == 9).all()) and torch.initial_seed() == 9
        raise ZeroDivisionError
    assert bool((cards.states[1] == 7).all()) and torch.initial_seed() != 9
