"""The model card of a shared agent, and its results in the forms that the hub reads."""

import json
from collections.abc import Mapping
from typing import Any

from arcade_torch.tools.imports import is_from_user
from arcade_torch.tools.names import bare_name

Results = Mapping[str, Any]

LIBRARY = "arcade-torch"
TAGS = ("reinforcement-learning", "deep-reinforcement-learning", "popgym-arcade", LIBRARY)


def model_card(repo: str, results: Results, video: str) -> str:
    """``README.md``: front matter with the ``model-index`` that boards read, then a page.

    Args:
        repo: what the agent is called, ``owner/name`` or a folder's name.
        results: what `results_of` of ``share`` gave.
        video: name of the film beside it; empty for none.
    """
    env = results["env"]
    twin = results["observability"]
    value = f"{results['mean_reward']:.3f} +/- {results['std_reward']:.3f}"
    tags = "\n".join(f"- {_scalar(tag)}" for tag in (*TAGS, env))
    film = f"\n![An episode]({video})\n" if video.endswith(".gif") else ""
    if video.endswith(".mp4"):
        film = f"\n[An episode]({video})\n"
    return f"""---
library_name: {LIBRARY}
tags:
{tags}
model-index:
- name: {_scalar(f"{results['algorithm']}-{results['memory']}")}
  results:
  - task:
      type: reinforcement-learning
      name: reinforcement-learning
    dataset:
      name: {_scalar(f"{env}, {twin}")}
      type: {_scalar(env)}
    metrics:
    - type: mean_reward
      value: {_scalar(value)}
      name: mean_reward
      verified: false
---

# {results["algorithm"].upper()} with {results["memory"]} on {env} ({twin})

Mean greedy return **{value}** over {results["n_eval_episodes"]:,} episodes on held-out seeds, after
{results["frames"]:,} frames of training from seed {results["seed"]}. Trained with arcade-torch,
which is POPGym Arcade for PyTorch.
{film}{_registered(results["memory"])}
```python
from arcade_torch.agents import evaluate, from_pretrained

agent = from_pretrained(
    {_scalar(repo)},
    sha256={_scalar(results["sha256"]["model.safetensors"])},
)
print(evaluate(agent).text)
```

`config.json` has all settings of the training, `results.json` how it was made and measured.
"""


def _registered(memory: str) -> str:
    """What to do before the agent is loaded, where its memory is none of this package."""
    if not is_from_user(memory):
        return ""
    return (
        f"\nIts memory is none of that package, and no code comes with it: import what calls\n"
        f"`register_memory({_scalar(memory)}, ...)` first, with a command by `--import FILE.py`.\n"
    )


def eval_results(results: Results) -> str:
    """A file of ``.eval_results``: what was measured on what, when, in YAML."""
    twin = results["observability"]
    episodes = results["n_eval_episodes"]
    notes = f"mean greedy return of {episodes} episodes on held-out seeds, twin {twin}"
    lines = [
        "- dataset:",
        f"    id: {_scalar('popgym-arcade')}",
        f"    task_id: {_scalar(results['env'] + '-' + twin)}",
        f"  value: {results['mean_reward']:.6g}",
        f"  date: {_scalar(results['date'])}",
        f"  notes: {_scalar(notes)}",
    ]
    return "\n".join(lines) + "\n"


def suggested_name(results: Results) -> str:
    """What a repository may be called, ``{algo}-{memory}-{env}``, with its twin."""
    game = bare_name(results["env"])
    parts = (results["algorithm"], results["memory"], game, results["observability"])
    return "-".join(parts).lower()


def _scalar(text: str) -> str:
    """Text as YAML: what is JSON is YAML."""
    return json.dumps(text)
