"""Who can be recorded: each looks at a session and names an action."""

from pathlib import Path
from typing import Any, Protocol

import numpy as np

from arcade_torch.envs_jax.oracles import Player, RandomPlayer, make_oracle
from arcade_torch.tools.play.session import Session

SCRIPTED = ("random", "state-oracle", "frames-oracle")


class Chooser(Protocol):
    """Somebody who plays a session."""

    def choose(self, session: Session) -> int:
        """The next action, 0 to 4."""


class Scripted:
    """The random player or an oracle of the games."""

    def __init__(self, player: Player, sees: str) -> None:
        self._player, self._sees = player, sees

    def choose(self, session: Session) -> int:
        """See `Chooser`."""
        seen: Any = None
        if self._sees != "nothing":
            seen = session.state if self._sees == "state" else session.view(partial=True)
        return int(self._player.act(seen, np.array([session.steps == 0]))[0])


class Trained:
    """A trained agent, greedy; it sees what it would see in an ``ArcadeEnv`` of one env."""

    def __init__(self, agent: Any, partial: bool) -> None:
        self._agent, self._partial = agent, partial
        self._state = agent.initial_state(1)
        self._last_action = 0

    def choose(self, session: Session) -> int:
        """See `Chooser`."""
        import torch
        from tensordict import TensorDict

        device = self._agent.config.device if torch.cuda.is_available() else "cpu"
        obs = TensorDict(
            {
                "pixels": torch.from_numpy(session.view(self._partial)),
                "last_action": torch.tensor([self._last_action]),
                "is_init": torch.tensor([[session.steps == 0]]),
                "step_count": torch.tensor([[session.steps]]),
                "episode_reward": torch.tensor([[session.total]]),
            },
            batch_size=[1],
        ).to(device)
        with torch.no_grad():
            action, _, self._state = self._agent.act(obs, self._state)
        self._last_action = int(action)
        return self._last_action


def scripted(name: str, game: Any, seed: int) -> Scripted:
    """A player by its name."""
    if name == "random":
        return Scripted(RandomPlayer(seed), "nothing")
    kind = "state" if name == "state-oracle" else "frames"
    return Scripted(make_oracle(game, "state" if kind == "state" else "frames"), kind)


def load_agent(player: str) -> Any:
    """The agent in a run folder."""
    if not Path(player).is_dir():
        raise ValueError(f"--player is {player!r}, allowed: {', '.join(SCRIPTED)}, or a run folder")
    from arcade_torch.agents import load

    return load(player)
