"""What agents and games are called, and which of several names mean the same."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, get_args, get_type_hints

from arcade_torch.agents.differences import flatten
from arcade_torch.envs_jax import resolve_id
from arcade_torch.tools.text import printable

_VERSION = re.compile(r"-v\d+(?=$|\+)")


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
        rest = {}
        for name, value in flatten(options).items():
            rest[name] = str(plain_number(value))
        layers = rest.pop("layers", None)
        width = rest.pop("hidden_size", None)
        size = ""
        if layers is not None or width is not None:
            default = preset_size(network)
            default_layers, default_width = default.split("x")
            size = f"{layers or default_layers}x{width or default_width}"
            if size == default:
                size = ""
        algorithm = str(config.get("algorithm", "pqn"))
        return cls(algorithm, config["memory"], network, size, tuple(sorted(rest.items())))


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
    agents = list(dict.fromkeys(keys))
    several_algorithms = _several(key.algorithm for key in agents)
    several_networks = _several(key.network for key in agents)
    by_memory: dict[str, list[AgentKey]] = {}
    for key in agents:
        by_memory.setdefault(key.memory, []).append(key)
    names = {}
    for key in agents:
        rivals = by_memory[key.memory]
        parts = [key.memory]
        if several_algorithms and key.algorithm:
            parts = [f"{key.algorithm}-{key.memory}"]
        if sized or len({rival.size for rival in rivals}) > 1:
            parts.append(key.size or preset_size(key.network or "paper"))
        if several_networks and key.network:
            parts.append(key.network)
        shared = set.intersection(*(set(rival.options) for rival in rivals))
        for option, value in key.options:
            if (option, value) not in shared:
                parts.append(f"{option}={value}")
        names[key] = printable(" ".join(parts))
    return names


def find_agent(names: Mapping[AgentKey, str], wanted: str) -> str:
    """The agent that a name means: its very name, or the memory that no other agent has.

    Example:
        >>> find_agent({AgentKey("pqn", "lru"): "pqn-lru", AgentKey("ppo", "gru"): "gru"}, "lru")
        'pqn-lru'
    """
    if wanted in names.values():
        return wanted
    agents = []
    for key, name in names.items():
        if key.memory == wanted:
            agents.append(name)
    if len(agents) == 1:
        return agents[0]
    if agents:
        raise ValueError(f"subject {wanted!r} is several agents, name one: {', '.join(agents)}")
    raise ValueError(
        f"subject {wanted!r} is none of the agents with finished runs, {', '.join(names.values())}"
    )


def _several(words: Iterable[str]) -> bool:
    """Whether there are several different words; empty ones do not count."""
    return len(set(words) - {""}) > 1


def memory_free(agent: str, baseline: str, others: Iterable[str] = ()) -> re.Match[str] | None:
    """Whether an agent is the memory-free one, in any case and size; group 1 is its algorithm,
    ``ppo-``, or empty.

    A word in front is an algorithm if it is one of ours, or if one of the ``others``, with memory,
    has it too: ``gated-mlp`` alone is a memory of its own.
    """
    match = named_like(agent, baseline)
    if match is None or match[1].lower().removesuffix("-") in ("", *algorithms()):
        return match
    prefix = match[1].lower()
    for other in others:
        if other.lower().startswith(prefix) and named_like(other, baseline) is None:
            return match
    return None


def named_like(agent: str, baseline: str) -> re.Match[str] | None:
    """The name of an agent as that of the memory-free one, with a word in front and a size."""
    return re.fullmatch(rf"(|\S*-){re.escape(baseline)}( .*)?", agent, re.IGNORECASE)


@cache
def algorithms() -> tuple[str, ...]:
    """The algorithms of our agents."""
    from arcade_torch.agents.config import TrainConfig

    return get_args(get_type_hints(TrainConfig)["algorithm"])


def find_baselines(agents: Sequence[str], baseline: str) -> dict[str, str]:
    """Agent -> the memory-free agent of its algorithm, where there is one; that of the very name or
    of PQN is first.
    """
    prefixes = {}  # of the memory-free agents: ``ppo-``, or empty
    for agent in agents:
        match = memory_free(agent, baseline, agents)
        if match is not None:
            prefixes[agent] = match[1].lower()

    def rank(agent: str) -> tuple[bool, bool]:
        return agent.lower() != baseline.lower(), prefixes[agent] != "pqn-"

    free = sorted(prefixes, key=rank)
    first: dict[str, str] = {}
    for agent in free:
        first.setdefault(prefixes[agent], agent)
    baselines = {}
    for agent in (*free, *agents):
        fitting = [prefix for prefix in first if agent.lower().startswith(prefix)]
        if fitting:
            baselines[agent] = first[max(fitting, key=len)]
    return baselines


def game_names(written: Iterable[str]) -> dict[str, str]:
    """One name for each game that is written in several ways: with its version, without, or by an
    alias.

    A name without a version stands for the newest version that is there. A game that is always
    written in the same way keeps that name.

    Example:
        >>> game_names(["NoisyPoleEasy", "NoisyCartPoleEasy-v0", "TetrisEasy"])["NoisyPoleEasy"]
        'NoisyCartPoleEasy-v0'
    """
    spellings: dict[str, list[str]] = {}  # of the games
    for name in dict.fromkeys(written):
        spellings.setdefault(bare_name(name), []).append(name)
    names: dict[str, str] = {}
    for game, spelt in spellings.items():
        newest = max(map(_version, spelt), key=_number)
        for name in spelt:
            one_name = name if len(spelt) == 1 else game + (_version(name) or newest)
            names[name] = printable(one_name)
    return names


def _version(game: str) -> str:
    """The version in the name of a game, such as ``-v0``; empty if it has none."""
    match = _VERSION.search(game)
    return match[0] if match else ""


def _number(version: str) -> int:
    """The number of a version; -1 of an empty one."""
    return int(version.removeprefix("-v") or -1)


def bare_name(game: str) -> str:
    """The name of a game without version; an alias is resolved if the game is registered here."""
    bare = _VERSION.sub("", game)
    try:
        return _VERSION.sub("", resolve_id(bare))
    except ValueError:
        return bare
