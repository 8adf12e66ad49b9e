"""The memory models work where nothing but torch, tensordict and numpy is installed."""

import subprocess
import sys

MISSING = (
    "jax",
    "jaxlib",
    "torchrl",
    "gymnasium",
    "matplotlib",
    "tyro",
    "rich",
    "safetensors",
    "filelock",
)

PROGRAM = """
import sys
for name in {missing!r}:
    sys.modules[name] = None  # to Python, a package that is not installed
import torch
import arcade_torch.models as models
{body}
"""


def run(body):
    program = PROGRAM.format(missing=MISSING, body=body)
    command = [sys.executable, "-W", "error::ImportWarning", "-c", program]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


BODIES = {
    "memory": "memory = models.make_memory('lru', 3, 4)\nprint(len(models.check_memory(memory)))",
    "network": "network = models.make_network('small', memory='gru')\n"
    "x = torch.zeros(2, 3, 128, 128, 3, dtype=torch.uint8)\n"
    "flags = torch.zeros(2, 3, dtype=torch.bool)\n"
    "action = torch.zeros(2, 3, dtype=torch.int64)\n"
    "y, _ = network.remember(network.encode(x), action, flags, network.initial_state(2))\n"
    "print(y.shape)",
    "names": "print(models.memory_names())",
}
ASKS = """
print("then the module")
module = models.MemoryModule(models.make_memory('gru', 3, 4))
from tensordict import TensorDict
data = TensorDict({'embed': torch.zeros(2, 3), 'is_init': torch.ones(2, 1, dtype=torch.bool)}, [2])
module(data)
"""


def test_models_work_alone_and_only_memory_module_asks_for_torchrl():
    """One process, of which torch's import is the most."""
    done = run("\n".join([*BODIES.values(), ASKS]))
    laws, shape, names, last = done.stdout.splitlines()
    assert int(laws) > 0 and shape.startswith("torch.Size([2, 3,") and "gru" in names
    assert last == "then the module", done.stderr
    assert done.returncode != 0 and "torchrl" in done.stderr.splitlines()[-1]
