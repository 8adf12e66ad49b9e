"""AutoEncode: watch a row of cards, then name their suits in reverse order."""

from typing import ClassVar

from arcade_torch.envs_jax.autoencode import rules
from arcade_torch.envs_jax.autoencode.oracle import FramesOracle, StateOracle
from arcade_torch.envs_jax.autoencode.renderer import Screen
from arcade_torch.envs_jax.autoencode.rules import LEVELS, AutoEncodeState, Params
from arcade_torch.envs_jax.game import Array, LevelGame, Rules


class AutoEncode(LevelGame[AutoEncodeState]):
    """Watch N cards of four suits, one a step, then give the suits back, the last one first.

    For the first N steps the card of the step is on the table, whatever the player does. From then
    on action 4 answers with the suit of the selector: ``1 / N`` if it is the suit of the last card
    not yet answered, else 0; either way that card is gone. Actions 2 and 3 turn the selector one
    suit on and back (heart, spade, club, diamond, round and round), at all times. The N-th answer
    terminates, ``10 N`` steps truncate. Returns lie in [0, 1].

    The MDP twin shows the stack of cards watched and not yet answered, the POMDP twin does not.
    Both show the card on the table, the selector and the number of right answers.

    Args:
        rules: ``"reference"`` makes the first step after the watch an answer whatever the action,
            judges both ends one step late (returns up to 1 + 1 / N), and leaves the stack of the
            MDP twin whole.
        mdp_marker: Whether answered cards leave the stack of the MDP twin. Unless given, they do by
            default and do not with ``rules="reference"``.

    Source: POPGym Arcade (ICML 2026). Differs from popgym-arcade 0.0.7 in: only action 4 answers,
        ends are not one step
    late, the stack shows how many answers were given, symbols do not overlap at 128 pixels.

    Raises:
        ValueError: ``mdp_marker`` is not a bool.
    """

    levels = LEVELS
    memory_kind: ClassVar = "recall"
    oracles: ClassVar = {"state": StateOracle, "frames": FramesOracle}

    def __init__(
        self, level: Params, *, id: str, obs_size: int, rules: Rules, mdp_marker: bool | None = None
    ) -> None:
        if mdp_marker is not None and not isinstance(mdp_marker, bool):
            raise ValueError(
                f"mdp_marker is {mdp_marker!r}, allowed: True, False, or None for what the rules "
                "say"
            )
        super().__init__(level, id=id, obs_size=obs_size, rules=rules)
        self.mdp_marker = rules == "default" if mdp_marker is None else mdp_marker
        self.max_steps = level.max_steps
        self.return_range = (0.0, 1.0 + (rules == "reference") / level.cards)
        self.screen = Screen(obs_size, level, self.mdp_marker)

    def reset(self, key: Array) -> AutoEncodeState:
        """See :meth:`Game.reset`."""
        return rules.reset(key, self.level)

    def step(
        self, key: Array, state: AutoEncodeState, action: Array
    ) -> tuple[AutoEncodeState, Array, Array, Array]:
        """See :meth:`Game.step`."""
        del key  # nothing is random after the deal
        return rules.step(state, action, self.level, self.rules)

    def facts(self, state: AutoEncodeState) -> dict[str, Array]:
        """The suit that is to be named now; -1 while cards are dealt, and at the end."""
        return {"asked": rules.asked_suit(state, self.level)}
