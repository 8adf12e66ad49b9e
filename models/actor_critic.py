"""Actor and critic with memory: a network each, or one for both."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import Tensor, nn

from arcade_torch.models.arguments import is_whole
from arcade_torch.models.memory import batch_shape
from arcade_torch.models.networks import MemoryNetwork
from arcade_torch.models.presets import NetworkPreset, make_network, preset_of
from arcade_torch.models.recurrence import Key, Store

__all__ = ["ActorCriticNetwork", "current_names", "make_actor_critic"]


class ActorCriticNetwork(TensorDictModuleBase):
    """Actor and critic as one TensorDict module, which writes ``logits`` [*, A] and ``state_value``
    [*, 1].

    Either two towers, networks that share nothing but the frames, as in the paper, or one tower
    with both heads at half the price. The plain-tensor methods are those of :class:`MemoryNetwork`;
    their output is [..., A + 1], the value last, and their state has an entry for each tower.

    Args:
        actor: writes ``logits``; without a critic ``state_value`` too (``value_key``).
        critic: writes ``state_value``; sees frames of the same size. Its state key differs from the
            actor's.

    Attributes:
        towers: the networks by name: ``"actor"`` and ``"critic"``, or ``"both"``.
        offers: what :meth:`select` can read an output as.

    Raises:
        ValueError: without a critic, the actor has no head ``state_value``; with one, they write
            something else than their heads, share state keys, or see frames of another size.

    Source: POPGym Arcade (ICML 2026), PPO network table; the reference implementation's recurrent
        actor-critic.
    """

    offers = ("logits", "probs", "value")

    def __init__(self, actor: MemoryNetwork, critic: MemoryNetwork | None = None) -> None:
        super().__init__()
        if critic is not None:
            _check_towers(actor, critic)
            towers = {"actor": actor, "critic": critic}
        elif {"logits", "state_value"} <= actor.heads.keys():
            towers = {"both": actor}
        else:
            raise ValueError(
                "without a critic the actor must have the heads logits and state_value "
                f"(out_key and value_key), got {', '.join(map(str, actor.heads))}"
            )
        self.towers = nn.ModuleDict(towers)
        self.register_load_state_dict_pre_hook(_rename_weights)
        in_keys: list[Any] = []
        out_keys: list[Any] = []
        for tower in towers.values():
            in_keys.extend(tower.in_keys)
            out_keys.extend(tower.out_keys)
        self.in_keys = list(dict.fromkeys(in_keys))  # both read the frames
        self.out_keys = out_keys

    @property
    def actor(self) -> MemoryNetwork:
        """What writes ``logits`` by itself; where one tower has both heads, a view of it."""
        return self._head("actor", "logits")

    @property
    def critic(self) -> MemoryNetwork:
        """What writes ``state_value`` by itself; where one tower has both heads, a view of it."""
        return self._head("critic", "state_value")

    @property
    def estimator(self) -> MemoryNetwork:
        """The same as :attr:`critic`: its name of before."""
        return self.critic

    @dispatch  # type: ignore[untyped-decorator]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run all towers, see :meth:`MemoryNetwork.forward`; the value is [*batch, 1]."""
        for tower in self.towers.values():
            tower(tensordict)
        return tensordict

    def compress(self, pixels: Tensor) -> Tensor:
        """What of the frames is worth storing, see :meth:`MemoryNetwork.compress`; the same for
        all towers.
        """
        return self.actor.compress(pixels)

    def calibrate(self, pixels: Tensor) -> None:
        """Set the input scaling from frames of random play."""
        for tower in self._towers().values():
            tower.calibrate(pixels)

    def encode(self, pixels: Tensor) -> Tensor:
        """Frames to features, float [..., E], of two towers [..., 2 E], the actor's first."""
        features = [tower.encode(pixels) for tower in self._towers().values()]
        return torch.cat(features, dim=-1)

    def remember(
        self, features: Tensor, last_action: Tensor, is_init: Tensor, state: TensorDict
    ) -> tuple[Tensor, TensorDict]:
        """Everything behind :meth:`encode`, see :meth:`MemoryNetwork.remember`; the output is [B,
        T, A + 1].
        """
        features_of_towers = features.chunk(len(self.towers), dim=-1)
        outputs = []
        states = {}
        for (name, tower), part in zip(self._towers().items(), features_of_towers, strict=True):
            out, states[name] = tower.remember(part, last_action, is_init, state[name])
            outputs.append(out)
        return torch.cat(outputs, dim=-1), TensorDict(states, batch_size=state.batch_size)

    def initial_state(self, batch_size: int | Sequence[int]) -> TensorDict:
        """Recurrent state at the start of an episode, TensorDict [batch_size]."""
        states = {}
        for name, tower in self._towers().items():
            states[name] = tower.initial_state(batch_size)
        return TensorDict(states, batch_size=batch_shape(batch_size))

    @staticmethod
    def by_head(out: Tensor) -> dict[Key, Tensor]:
        """An output [..., A + 1] cut into the heads: ``logits`` [..., A], ``state_value`` [...,
        1].
        """
        return {"logits": out[..., :-1], "state_value": out[..., -1:]}

    @classmethod
    def select(cls, out: Tensor, quantity: str) -> Tensor:
        """Read an output as one of :attr:`offers`.

        Args:
            out: float [..., A + 1].
            quantity: "logits", "probs" (of the actions) or "value".

        Returns:
            float [..., A], for "value" [..., 1].

        Raises:
            ValueError: another word.
        """
        heads = cls.by_head(out)
        if quantity == "logits":
            return heads["logits"]
        if quantity == "probs":
            return heads["logits"].softmax(-1)
        if quantity == "value":
            return heads["state_value"]
        raise ValueError(f"an actor-critic offers {', '.join(cls.offers)}, not {quantity!r}")

    def _towers(self) -> dict[str, MemoryNetwork]:
        """The towers, with their type."""
        return dict(self.towers.items())  # type: ignore[arg-type]

    def _head(self, tower: str, head: str) -> MemoryNetwork:
        towers = self._towers()
        return towers["both"].only(head) if "both" in towers else towers[tower]


def _check_towers(actor: MemoryNetwork, critic: MemoryNetwork) -> None:
    """Raise ValueError unless two networks can be actor and critic."""
    if "logits" not in actor.heads or "state_value" not in critic.heads:
        heads = [", ".join(map(str, tower.heads)) for tower in (actor, critic)]
        raise ValueError(
            "the actor must write logits, and the critic state_value (out_key), got "
            f"{heads[0]} and {heads[1]}"
        )
    shared = set(actor.state_keys) & set(critic.state_keys)
    if shared:
        raise ValueError(
            "the state keys of actor and critic must differ, got "
            f"{', '.join(map(str, sorted(shared)))} in both: give each a state_key"
        )
    if actor.obs_size != critic.obs_size:
        raise ValueError(
            f"actor and critic see frames of {actor.obs_size} and of {critic.obs_size} pixels, "
            "which must be the same"
        )


OLD_NAMES = {
    "actor.module.0.": "towers.both.",
    "actor.": "towers.actor.",
    "critic.": "towers.critic.",
}
"""Names that the weights of an :class:`ActorCriticNetwork` began with up to 0.2, and today's."""


def current_names(weights: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Weights of an :class:`ActorCriticNetwork` under the names that they have today.

    Args:
        weights: what a ``state_dict`` gave, maybe of an older version.
        prefix: of the actor-critic in a larger module; other weights keep their names.
    """
    renamed = {}
    for name, value in weights.items():
        for old, new in OLD_NAMES.items():
            if name.startswith(prefix + old):
                name = prefix + new + name.removeprefix(prefix + old)
                break
        renamed[name] = value
    return renamed


def _rename_weights(network: nn.Module, weights: dict[str, Any], prefix: str, *_: Any) -> None:
    """Let ``load_state_dict`` take weights of older versions."""
    renamed = current_names(weights, prefix)
    weights.clear()
    weights.update(renamed)


def _check_options(options: dict[str, Any], num_actions: Any) -> None:
    """Refuse options that two towers would drop in silence, and a number of actions below 1."""
    unknown = sorted(set(options) - set(NetworkPreset.__dataclass_fields__))
    if unknown:
        raise TypeError(
            f"unknown network option {', '.join(unknown)}; allowed are "
            f"{', '.join(NetworkPreset.__dataclass_fields__)}"
        )
    if "head" in options and "actor_critic_head" in options:
        raise ValueError("head and actor_critic_head are two names of one option: give one")
    if not is_whole(num_actions) or num_actions < 1:
        raise ValueError(f"num_actions must be a whole number from 1, got {num_actions!r}")


def make_actor_critic(
    preset: str = "paper",
    memory: str | Callable[..., nn.Module] = "lru",
    *,
    obs_size: int = 128,
    num_actions: int = 5,
    memory_options: dict[str, Any] | None = None,
    store: Store = "sequence",
    **options: Any,
) -> ActorCriticNetwork:
    """Make actor and critic: two networks, each with its own initial weights, or one (``towers=1``;
    "small").

    Args:
        preset: see :func:`make_network`; the heads are the preset's ``actor_critic_head`` unless
            ``head`` is given.
        memory: see :func:`make_network`.
        obs_size: side of the frames in pixels.
        num_actions: A.
        memory_options: options of the cells, over those of the preset.
        store: see :func:`make_network`.
        **options: the other fields of :class:`NetworkPreset`, see :func:`make_network`;
            ``use_last_action=False`` is the published code, unlike its table.

    Returns:
        The module; states stand under ``("memory", "actor")`` and ``("memory", "critic")``, or
        ``("memory", "both")``.

    Raises:
        ValueError: unknown preset, memory, size, or value of an option.
        TypeError: unknown option.

    Example:
        >>> network = make_actor_critic("small", "gru")
        >>> frames = torch.zeros(2, 7, 128, 128, 3, dtype=torch.uint8)
        >>> last_action = torch.zeros(2, 7, dtype=torch.int64)
        >>> is_init = torch.zeros(2, 7, dtype=torch.bool)
        >>> features = network.encode(frames)
        >>> out, state = network.remember(features, last_action, is_init, network.initial_state(2))
        >>> network.by_head(out)["logits"].shape
        torch.Size([2, 7, 5])
    """
    settings = preset_of(preset)
    _check_options(options, num_actions)
    options.setdefault("head", options.pop("actor_critic_head", settings.actor_critic_head))
    options |= {
        "obs_size": obs_size,
        "num_actions": num_actions,
        "memory_options": memory_options,
        "store": store,
    }

    def tower(name: str, **more: Any) -> MemoryNetwork:
        return make_network(preset, memory, state_key=("memory", name), **(options | more))

    if options.get("towers", settings.towers) == 1:
        both = tower("both", num_outputs=num_actions, out_key="logits", value_key="state_value")
        return ActorCriticNetwork(both)
    actor = tower("actor", num_outputs=num_actions, out_key="logits")
    critic = tower("critic", num_outputs=1, out_key="state_value", predicts=False)
    return ActorCriticNetwork(actor, critic)
