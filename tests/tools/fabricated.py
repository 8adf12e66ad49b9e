"""Run folders as the trainer writes them, without any training."""

import json
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from arcade_torch.tools.studies.engines import Job
from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study

FINAL = {
    ("full", "mingru"): 0.51,
    ("full", "mlp"): 0.45,
    ("partial", "mingru"): 0.47,
    ("partial", "mlp"): 0.30,
}


def small_study(**changes: object) -> Study:
    """One game, two twins, two agents, two seeds."""
    values = {
        "name": "toy",
        "games": ["MineSweeperEasy"],
        "memories": ["mingru", "mlp"],
        "seeds": [0, 1],
        "preset": "smoke",
        "total_frames": 2048,
    }
    return Study.from_dict(values | changes)


def write_run(
    path: Path,
    run: RunSpec,
    final: float,
    frames: int = 350_000,
    status: str = "finished",
    settings: Mapping[str, Any] | None = None,
) -> None:
    """A run folder with config, metrics, evaluations and progress; finished unless told
    otherwise.
    """
    rng = np.random.default_rng(abs(hash((run.memory, run.observability, run.seed))) % 2**32)
    path.mkdir(parents=True, exist_ok=True)
    config = {
        "env": run.game,
        "observability": run.observability,
        "memory": run.memory,
        "seed": run.seed,
        "algorithm": run.algorithm,
        "total_frames": frames,
        "pqn": {"gamma": 0.99, "lam": 0.8},
    } | dict(settings or {})
    (path / "config.json").write_text(
        json.dumps({"config": config, "versions": {}, "command": ["x"]})
    )
    xs = np.linspace(frames / 5, frames, 5).astype(int)
    means = final * np.linspace(0.1, 1.0, 5) + 0.02 * rng.standard_normal(5)
    lines = ["frames,mean,std,n", *(f"{x},{m:.4f},0.3,128" for x, m in zip(xs, means, strict=True))]
    (path / "eval.csv").write_text("\n".join(lines) + "\n")
    xs = np.linspace(2048, frames, 40).astype(int)
    means = final * np.linspace(0.0, 0.9, 40)
    lines = ["frames,train_return_ewm", *(f"{x},{m:.4f}" for x, m in zip(xs, means, strict=True))]
    (path / "metrics.csv").write_text("\n".join(lines) + "\n")
    progress = {
        "frames": frames if status == "finished" else frames // 2,
        "total_frames": frames,
        "status": status,
    }
    (path / "progress.json").write_text(json.dumps(progress))
    if status == "finished":
        values = {
            "status": status,
            "frames": frames,
            "seconds": 95.0,
            "mean": final,
            "train_max_ewm": 0.9 * final,
        }
        values |= {"returns": [final - 0.1, final + 0.1], "lengths": [20, 30]}
        (path / "eval.json").write_text(json.dumps(values))


def write_study(root: Path, study: Study, spread: float = 0.02) -> StudyFolder:
    """A finished study."""
    folder = StudyFolder(root)
    folder.claim(study, "arcade-torch demo")
    for run in study.runs():
        shift = spread * (run.seed - (len(study.seeds) - 1) / 2)
        settings = study.config(run).to_dict()
        write_run(
            folder.run(run).path,
            run,
            FINAL[run.observability, run.memory] + shift,
            settings=settings,
        )
    folder.write_results(study)
    return folder


def jobs(tmp_path: Path, *scripts: str) -> list[Job]:
    """Jobs whose config is Python code, for an engine that executes it."""
    found = []
    for name, text in ((f"job{i}", textwrap.dedent(text)) for i, text in enumerate(scripts)):
        (tmp_path / f"{name}.py").write_text(text)
        found.append(Job(name, tmp_path / f"{name}.py", tmp_path / name, tmp_path / f"{name}.log"))
    return found
