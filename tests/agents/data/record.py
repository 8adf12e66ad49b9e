"""Record what the losses of commit 44399dd compute, in float64. It runs against that commit only;
see README.md.
"""

import copy
import sys
from pathlib import Path

import torch
from safetensors.torch import save_file
from tensordict import TensorDict
from tiny import NETWORK  # beside this script

import arcade_torch
from arcade_torch.agents.dqn import DQNLoss
from arcade_torch.agents.ppo import PPOLoss
from arcade_torch.agents.pqn import PQNLoss
from arcade_torch.frames import next_pixels
from arcade_torch.models import make_actor_critic, make_network

GAMES, ALGORITHMS, MEMORIES = (
    ("MineSweeperEasy", "NavigatorEasy"),
    ("pqn", "ppo", "dqn"),
    ("lru", "gru", "mlp"),
)
ENVS, NEW, OVERLAP = 32, 12, 4
DATA = Path(__file__).parent


class Player:
    """Plays at random, the same actions for all networks, and runs each network for its state."""

    def __init__(self, networks, num_actions):
        self.networks, self.num_actions, self.states = networks, num_actions, []
        self.generator = torch.Generator().manual_seed(5)

    def initial_state(self, batch_size):
        return TensorDict(
            {name: net.initial_state(batch_size) for name, net in self.networks.items()},
            [batch_size],
        )

    @torch.no_grad()
    def act(self, obs, state):
        self.states.append(state.clone())
        pixels, last_action = obs["pixels"].unsqueeze(1), obs["last_action"].reshape(-1, 1)
        action = torch.randint(self.num_actions, (len(last_action),), generator=self.generator)
        after, extras = self.initial_state(len(last_action)), {}
        for name, network in self.networks.items():
            out, after[name] = network(
                pixels, last_action, obs["is_init"].reshape(-1, 1), state[name]
            )
            if name.startswith("ppo"):
                log_probs = network.split(out.squeeze(1))[0].log_softmax(-1)
                extras[f"log_prob_{name}"] = log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1)
        return action, extras, after


def choose_rows(terminated, truncated):
    """Four rows: both endings inside, a truncation inside, an end at the last step, no end; None if
    there are none.
    """
    inside, any_end = slice(OVERLAP + 1, -1), (terminated | truncated)
    cut = truncated[:, inside].any(1)
    wanted = (terminated[:, inside].any(1) & cut, cut, any_end[:, -1], ~any_end.any(1))
    rows = []
    for mask in wanted:
        found = [row for row in mask.nonzero().flatten().tolist() if row not in rows]
        if not found:
            return None
        rows.append(found[0])
    return rows


def collect(game, networks):
    """Sequences [4] with overlap 4, their recurrent states before steps 0 and 4."""
    env = arcade_torch.make(game, num_envs=ENVS, observability="partial", seed=3)
    compress = next(iter(networks.values())).compress
    player = Player(networks, env.game.num_actions)
    options = {"context": OVERLAP, "compress": compress, "final_frames": "truncated"}
    collector = arcade_torch.ArcadeCollector(env, player, frames_per_batch=ENVS * NEW, **options)
    for window in range(40):
        batch = collector.collect()
        # Scale the input by the first frames; the states of later windows are those of the new scale.
        if window == 0:
            for network in networks.values():
                network.calibrate(batch["pixels"])
        terminated, truncated = (
            batch["next", key].squeeze(-1) for key in ("terminated", "truncated")
        )
        rows = choose_rows(terminated, truncated & ~terminated)
        if window > 1 and rows is not None:
            states = {
                overlap: player.states[window * NEW + OVERLAP - overlap][rows]
                for overlap in (0, OVERLAP)
            }
            batch = batch[rows].clone()
            for key, value in batch["initial_state"].items(True, True):
                assert torch.equal(value, states[OVERLAP][key])
            print(game, "window", window, "rows", rows, "time limit", env.game.max_steps)
            return batch, states
    raise RuntimeError(f"{game}: no window has all endings")


def with_overlap(batch, state, overlap, log_prob=None):
    """The batch with so many steps of the window before, as the collector gives it."""
    first = OVERLAP - overlap
    cut = TensorDict(
        {"initial_state": state, "next_pool": batch.get("next_pool")}, batch.batch_size
    )
    for key in ("pixels", "action", "last_action", "is_init"):
        cut[key] = batch[key][:, first:]
    for key in ("reward", "terminated", "truncated", "frame_slot"):
        cut["next", key] = batch["next", key][:, first:]
    if log_prob is not None:
        cut["action_log_prob"] = log_prob[:, first:]
    return cut


def disturbed(network, scale, seed):
    """A copy with other parameters."""
    generator, network = torch.Generator().manual_seed(seed), copy.deepcopy(network)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return network


def grads(network, loss):
    network.zero_grad()
    loss.backward()
    return {
        f"grad/{name}": torch.zeros_like(p) if p.grad is None else p.grad
        for name, p in network.named_parameters()
    }


def q_case(loss, batch):
    out = loss.compute(loss.read(batch))
    return {
        "loss": out.loss,
        "target": out.target,
        "next_value": out.next_value,
        **grads(loss.network, out.loss),
    }


def pqn_cases(network, batches):
    for overlap, batch in batches.items():
        for bootstrap in ("next", "last"):
            for limit in ("bootstrap", "terminal"):
                loss = PQNLoss(network, time_limit=limit, bootstrap=bootstrap)
                yield (
                    f"overlap={overlap},bootstrap={bootstrap},time_limit={limit}",
                    q_case(loss, batch),
                )


def dqn_cases(network, target, batches):
    variants = (
        ("", {}),
        (",target_network=1", {"target_network": target}),
        (",time_limit=terminal", {"time_limit": "terminal"}),
        (",lam=0.8", {"lam": 0.8}),
        (",burn_in=2", {"burn_in": 2}),
    )
    for overlap, batch in batches.items():
        for name, options in variants[: 2 if overlap == 0 else None]:
            loss = DQNLoss(network, **({"lam": 0.0} | options))
            yield f"overlap={overlap}{name}", q_case(loss, batch)


def ppo_cases(network, later, batches):
    for overlap, batch in batches.items():
        for limit in ("bootstrap", "terminal"):
            loss, name = PPOLoss(network, time_limit=limit), f"overlap={overlap},time_limit={limit}"
            window = loss.prepare(loss.read(batch))
            kept = {key: window.extras[key] for key in ("advantage", "value_target", "state_value")}
            yield name, kept | ppo_case(loss, window)
            if overlap and limit == "bootstrap":
                yield f"{name},later=1", ppo_case(PPOLoss(later, time_limit=limit), window)


def ppo_case(loss, window):
    out = loss.compute(window)
    parts = {"loss": out.loss, "policy": out.policy, "value": out.value, "entropy": out.entropy}
    return parts | {"kl": out.kl, "clip_fraction": out.clip_share} | grads(loss.network, out.loss)


def record(game):
    """Write the files of a game."""
    torch.manual_seed(11)
    make = {"pqn": make_network, "dqn": make_network, "ppo": make_actor_critic}
    networks = {f"{a}-{m}": make[a](memory=m, **NETWORK) for a in ALGORITHMS for m in MEMORIES}
    batch, states = collect(game, networks)
    stored = (batch["next", "frame_slot"].squeeze(-1) >= 0)[..., None, None, None]
    flags = {key: batch["next", key].squeeze(-1) for key in ("reward", "terminated", "truncated")}
    experience = {
        **{key: batch[key] for key in ("pixels", "action", "last_action")},
        "is_init": batch["is_init"].squeeze(-1),
        **flags,
        "next_pixels": next_pixels(batch) * stored,
        "next_mask": stored.flatten(1),
    }
    write(game, experience)
    for name, behaviour in networks.items():
        network = disturbed(
            behaviour, 0.02, 1
        )  # float32, as everything that is read from the files
        other = disturbed(network, 0.1, 2)  # target network of DQN; PPO's after some gradient steps
        log_prob = batch.get(f"log_prob_{name}", None)
        batches = {o: with_overlap(batch, states[o][name], o, log_prob) for o in (0, OVERLAP)}
        out = {f"weights/{key}": value.clone() for key, value in network.state_dict().items()}
        others = {f"other/{key}": value.detach().clone() for key, value in other.named_parameters()}
        network.double(), other.double()
        batches = {overlap: doubled(each) for overlap, each in batches.items()}
        if name.startswith("pqn"):
            cases = pqn_cases(network, batches)
        else:
            out |= others
            cases = (dqn_cases if name.startswith("dqn") else ppo_cases)(network, other, batches)
        if log_prob is not None:
            out["action_log_prob"] = log_prob
        for overlap, state in states.items():
            for key, value in state[name].items(True, True):
                path = key if isinstance(key, str) else "/".join(key)
                out[f"state/{overlap}/{path}"] = value
        for case, values in cases:
            out |= {f"{case}/{key}": value for key, value in values.items()}
        write(f"{game}-{name}", out)


def doubled(batch):
    """Floats as float64; the frame pool stays what it is."""
    out = batch.copy()
    for key, value in batch.items(True, True):
        if isinstance(value, torch.Tensor) and value.is_floating_point():
            out[key] = value.double()
    return out


def write(name, tensors):
    file = DATA / f"{name}.safetensors"
    tensors = {
        key: value.float() if value.dtype == torch.float64 else value
        for key, value in tensors.items()
    }
    save_file({key: value.detach().clone().contiguous() for key, value in tensors.items()}, file)
    print(f"{file.stat().st_size:8d} {file.name}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    for each in sys.argv[1:] or GAMES:
        record(each)
