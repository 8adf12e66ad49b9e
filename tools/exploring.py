"""Whether a run stopped exploring before it learned: its policy has become deterministic while its
return stays where it began.
"""

import math
from collections.abc import Mapping, Sequence

from arcade_torch.envs_jax import games_of, make
from arcade_torch.tools.runs import Run

CERTAIN = 0.1
"""Entropy of a policy that hardly draws any more, as a share of that of equal chances."""
LITTLE = 0.1
"""Share of the way from the first return to the highest that a run has to make to have learned."""
PART = 0.02
"""Share of the rows that count as the beginning of a run, and as its end."""


def stopped_exploring(run: Run) -> str:
    """One line on a run that stopped exploring before it learned; empty where it did not.

    The first returns are those of an untrained policy, which is about the random player. Runs
    without an entropy (PQN and DQN explore by a schedule of their own) are never said to have
    stopped, nor those of games that are not registered here.

    Args:
        run: with ``metrics.csv``.
    """
    rows = run.table("metrics.csv")
    count = math.ceil(PART * len(rows))
    entropy = _mean(rows[-count:], "entropy")
    first = _mean(rows[:count], "train_return")
    last = _mean(rows[-count:], "train_return")
    if entropy is None or first is None or last is None:
        return ""
    try:
        games = [make(id) for id in games_of(run.game)]
    except ValueError:
        return ""
    certain = CERTAIN * math.log(games[0].num_actions)
    highest = sum(game.return_range[1] for game in games) / len(games)
    if entropy > certain or last - first > LITTLE * (highest - first):
        return ""
    return (
        f"stopped exploring before it learned: its entropy is {entropy:.3f}, and its return "
        f"{last:.3f}, where it began with {first:.3f} and {highest:.3g} can be had; another seed, "
        "or a larger ppo.entropy_coeff, may learn more"
    )


def _mean(rows: Sequence[Mapping[str, str]], column: str) -> float | None:
    """Mean of the finite numbers of a column; None if there are none."""
    numbers = list[float]()
    for row in rows:
        try:
            number = float(row.get(column, ""))
        except ValueError:
            continue
        if math.isfinite(number):
            numbers.append(number)
    return sum(numbers) / len(numbers) if numbers else None
