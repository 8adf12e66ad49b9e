"""Who is analysed, and where: an agent or its folder, and environments of its own game."""

from pathlib import Path
from typing import Any, Literal

from arcade_torch.tools.analysis.policy import policy_of
from arcade_torch.tools.analysis.windows import MAX_STEPS, Window, greedy_window

Twin = Literal["full", "partial"]

SIDE_BY_SIDE = 16
"""Episodes played at once where the caller brings no environments: at most 512 of their frames each are in memory."""


def resolve_agent(
    agent: Any, env: Any = None, observability: Twin | None = None, num_envs: int = SIDE_BY_SIDE
) -> tuple[Any, Any]:
    """Something that acts, and environments for it."""
    if isinstance(agent, str | Path):
        from arcade_torch.agents import load

        agent = load(agent)
    player = agent if hasattr(agent, "act") and hasattr(agent, "initial_state") else policy_of(agent)
    if env is not None:
        if observability is not None:
            raise ValueError("observability belongs to the environments: leave it out, or leave env out")
        return player, env
    if not hasattr(agent, "config"):
        raise ValueError(f"{type(agent).__name__} does not say which game it plays: hand over env as well")
    return player, own_env(agent, num_envs, observability)


def own_env(agent: Any, num_envs: int, observability: Twin | None = None, seed: int = 0) -> Any:
    """Environments of an agent's own game, on the device of its network."""
    import arcade_torch
    from arcade_torch.agents.evaluation import held_out_seed

    config = agent.config
    twin = observability or config.observability
    if twin not in ("full", "partial"):
        raise ValueError(f"this agent was trained on {twin} twins: name one of them, full or partial")
    return arcade_torch.make(
        config.env,
        num_envs=num_envs,
        observability=twin,
        obs_size=config.obs_size,
        seed=held_out_seed(seed),
        rules=config.rules,
        device=next(agent.network.parameters()).device,
        **dict(config.env_options),
    )


def episode_window(
    agent: Any, *, seed: int = 0, observability: Twin | None = None, max_steps: int = MAX_STEPS
) -> Window:
    """Play one greedy episode in the agent's own game."""
    from arcade_torch.agents.evaluation import held_out_seed

    env = own_env(agent, 1, observability, seed)
    return greedy_window(agent, env, seed=held_out_seed(seed), max_steps=max_steps)
