"""Plays on the second of two JAX devices, and says what of it was on the first.

    XLA_FLAGS=--xla_force_host_platform_device_count=2 python -m tests.arcade_torch.second_device

Two devices of the CPU stand for two GPUs, so nothing is drawn into memory of torch, as on a GPU.
Prints a JSON object: after which call arrays were left on the first device, and the programs that
were compiled for it.
"""

import json
from collections.abc import Callable
from typing import Any

import jax
import torch

from arcade_torch import ArcadeCollector, ArcadeEnv, from_jax, jax_env, rollout_buffer
from arcade_torch import env as env_module
from tests.arcade_torch.stub import LOCKSTEP, MIXED
from tests.arcade_torch.test_from_jax import Walk

N = 6
STEPS = 12


def left_on(device: jax.Device) -> list[str]:
    """The arrays that are on a device, as type and shape."""
    return [str(array.aval) for array in jax.live_arrays() if device in array.devices()]


def programs_for(device: jax.Device) -> list[str]:
    """The names of the programs that are compiled for a device."""
    names = set()
    for program in device.client.live_executables():
        if device in program.local_devices():
            names.add(program.hlo_modules()[0].name)
    return sorted(names)


def masked(env: ArcadeEnv, key: str) -> Any:
    """A root tensordict whose mask ``key`` is true in every other env."""
    root = env.rand_action(env.observe())
    root[key] = torch.arange(N) % 2 == 0
    return root


def calls(env: ArcadeEnv, branching: ArcadeEnv) -> dict[str, Callable[[], Any]]:
    """What a user does with an env, by name."""
    collector = ArcadeCollector(env, None, N * STEPS)
    state = env.get_state()
    return {
        "reset": env.reset,
        "step": lambda: env.step(env.rand_action(env.reset())),
        "masked step": lambda: env.step(masked(env, "_step")),
        "masked reset": lambda: env.reset(masked(env, "_reset").exclude("action")),
        "rollout": lambda: env.rollout(STEPS, break_when_any_done=False),
        "set_state": lambda: env.set_state(state),
        "state_dict": lambda: env.load_state_dict(env.state_dict()),
        "observe": env.observe,
        "set_observability": lambda: env.set_observability("partial"),
        "set_seed": lambda: env.set_seed(7),
        "collector": collector.collect,
        "collector again": collector.collect,
        "state in the tensordict": lambda: branching.rollout(STEPS, break_when_any_done=False),
    }


def foreign_calls() -> dict[str, Callable[[], Any]]:
    """What a user does with an env of another suite."""
    env = from_jax(Walk(), num_envs=N)
    state = env.get_state()
    rows = torch.arange(N).unsqueeze(-1) % 2 == 0
    return {
        "foreign reset": env.reset,
        "foreign step": lambda: env.step(env.rand_action(env.reset())),
        "foreign masked reset": lambda: env.reset(env.reset().set("_reset", rows)),
        "foreign rollout": lambda: env.rollout(STEPS, break_when_any_done=False),
        "foreign set_state": lambda: env.set_state(state),
        "foreign set_seed": lambda: env.set_seed(7),
    }


def main() -> None:
    """Play, and print."""
    first, second = jax.devices()
    env_module.pick_devices = lambda device: (torch.device("cpu"), second)
    jax_env.pick_devices = env_module.pick_devices
    rollout_buffer.is_host = lambda device: False
    left = {}
    games = [foreign_calls()]
    for game in (LOCKSTEP, MIXED):
        games.append(calls(ArcadeEnv(game, N), ArcadeEnv(game, N, state_in_td=True)))
    for game_calls in games:
        for name, call in game_calls.items():
            result = call()
            arrays = left_on(first)
            if arrays:
                left[name] = arrays
            del result
    used = len(left_on(second))
    print(json.dumps({"left": left, "programs": programs_for(first), "on the second": used}))


if __name__ == "__main__":
    main()
