"""What agents and games are called, and which of several names mean the same."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from arcade_torch.agents.config import flatten
from arcade_torch.envs_jax import resolve_id
from arcade_torch.tools.text import printable

_SIZE = ("layers", "hidden_size")
_VERSION = re.compile(r"-v\d+$")


@dataclass(frozen=True)
class AgentKey:
    """What makes two runs seeds of the same agent."""

    algorithm: str  # name of the learner; empty in tables that do not say
    memory: str  # name of the memory model, or of the agent in such a table
    network: str = ""  # preset of the network
    size: str = ""  # of the memory block, ``LAYERSxWIDTH``; empty for that of the preset
    options: tuple[tuple[str, str], ...] = ()  # other options of the network, (name, value), sorted

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> "AgentKey":
        """The key of a run, from its resolved settings."""
        options = config.get("network_options") or {}
        if not isinstance(options, Mapping) or not isinstance(config.get("memory"), str):
            raise ValueError("its memory or its network_options are of no use")
        network = str(config.get("network", "paper"))
        size = ""
        flat = {name: str(plain_number(value)) for name, value in flatten(options).items()}
        if any(name in flat for name in _SIZE):
            default = preset_size(network)
            chosen = "x".join(
                flat.get(name, base) for name, base in zip(_SIZE, default.split("x"), strict=True)
            )
            size = "" if chosen == default else chosen
        rest = tuple(sorted((name, value) for name, value in flat.items() if name not in _SIZE))
        return cls(str(config.get("algorithm", "pqn")), config["memory"], network, size, rest)


def plain_number(value: Any) -> Any:
    """A setting with its whole numbers as ints, in lists too: JSON files of one setting may say 1
    and 1.0.

    Example:
        >>> plain_number([1.0, 0.5, "1.0"])
        [1, 0.5, '1.0']
    """
    if isinstance(value, list | tuple):
        return [plain_number(item) for item in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def preset_size(network: str) -> str:
    """Layers and width of the memory block of a network preset, ``2x512``."""
    from arcade_torch.models.presets import preset_of

    preset = preset_of(network)
    return f"{preset.layers}x{preset.hidden_size}"


def agent_names(keys: Iterable[AgentKey], sized: bool = False) -> dict[AgentKey, str]:
    """The shortest names that tell agents apart: the memory, and whatever else differs among those
    that share it.

    Example:
        >>> list(agent_names([AgentKey("pqn", "lru"), AgentKey("ppo", "lru")]).values())
        ['pqn-lru', 'ppo-lru']
    """
    every = list(dict.fromkeys(keys))
    algorithms = {key.algorithm for key in every if key.algorithm}
    networks = {key.network for key in every if key.network}
    found = {}
    for key in every:
        same = [other for other in every if other.memory == key.memory]
        name = (
            f"{key.algorithm}-{key.memory}" if len(algorithms) > 1 and key.algorithm else key.memory
        )
        several = sized or len({other.size for other in same}) > 1
        parts = [key.size or preset_size(key.network or "paper")] if several else []
        parts += [key.network] if len(networks) > 1 and key.network else []
        shared = set.intersection(*(set(other.options) for other in same))
        parts += [
            f"{option}={value}" for option, value in key.options if (option, value) not in shared
        ]
        found[key] = printable(" ".join([name, *parts]))
    return found


def memory_free(agent: str, baseline: str) -> re.Match[str] | None:
    """Whether an agent is the memory-free one, in any case and size; group 1 is its algorithm,
    ``ppo-``, or empty.
    """
    return re.fullmatch(rf"(|\S*-){re.escape(baseline)}( .*)?", agent, re.IGNORECASE)


def find_baselines(agents: Sequence[str], baseline: str) -> dict[str, str]:
    """Agent -> the memory-free agent of its algorithm, where there is one; that of the very name or
    of PQN is first.
    """
    algorithm = {
        agent: found[1].lower() for agent in agents if (found := memory_free(agent, baseline))
    }
    free = sorted(
        algorithm, key=lambda agent: (agent.lower() != baseline.lower(), algorithm[agent] != "pqn-")
    )
    first = {algorithm[agent]: agent for agent in reversed(free)}
    own = {
        agent: [start for start in first if agent.lower().startswith(start)]
        for agent in (*free, *agents)
    }
    return {agent: first[max(starts, key=len)] for agent, starts in own.items() if starts}


def game_names(written: Iterable[str]) -> dict[str, str]:
    """One name for each game that is written in several ways: with its version, without, or by an
    alias.

    A name without a version stands for the newest version that is there. A game that is always
    written in the same way keeps that name.

    Example:
        >>> game_names(["NoisyPoleEasy", "NoisyCartPoleEasy-v0", "TetrisEasy"])["NoisyPoleEasy"]
        'NoisyCartPoleEasy-v0'
    """
    bare = {name: bare_name(name) for name in dict.fromkeys(written)}
    names = dict[str, str]()
    for name, game in bare.items():
        same = [other for other in bare if bare[other] == game]
        versions = [match[0] for other in same if (match := _VERSION.search(other))]
        match = _VERSION.search(name)
        newest = max(versions, key=lambda version: int(version[2:]), default="")
        names[name] = printable(name if len(same) == 1 else game + (match[0] if match else newest))
    return names


def bare_name(game: str) -> str:
    """The name of a game without version; an alias is resolved if the game is registered here."""
    bare = _VERSION.sub("", game)
    try:
        return _VERSION.sub("", resolve_id(bare))
    except ValueError:
        return bare
