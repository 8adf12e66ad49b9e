"""Studies: files with every field mutated, folders."""

import json
import os
import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given

from arcade_torch.tools.studies.folder import StudyFolder
from arcade_torch.tools.studies.grid import RunSpec, Study
from tests.fuzz.contract import attempt, content, fuzz
from tests.fuzz.hostile import NAMES, NUMBERS, mutated, mutated_value, seeds
from tests.fuzz.test_runs import _repair, _rewrite_json
from tests.tools.fabricated import small_study, write_study

pytestmark = pytest.mark.slow

TOML = b"""# what memory is worth
question = "Who remembers?"
games = ["MineSweeperEasy", "CartPoleEasy"]
memories = ["lru", "mlp"]
observability = ["full", "partial"]
algorithms = ["pqn"]
seeds = 3
preset = "small"
total_frames = 4096
sizes = ["1x64", "2x128"]
baseline = "mlp"

[settings]
eval_episodes = 16
device = "cpu"

[settings.pqn]
gamma = 0.9
lam = 0.5

[settings.env_options]
noise = 0.1
"""
VALUES: dict[str, Any] = {
    "name": "toy",
    "games": ["MineSweeperEasy"],
    "memories": ["lru", "mlp"],
    "seeds": [0, 1],
    "observability": ["full", "partial"],
    "algorithms": ["pqn"],
    "preset": "small",
    "total_frames": 4096,
    "settings": {"threads": 1, "pqn": {"gamma": 0.9}, "env_options": {"noise": 0.5}},
    "baseline": "mlp",
    "sizes": ["1x64"],
    "question": "why?",
}


def _use(study: Study) -> None:
    """What a dry run does with a study."""
    assert (
        Study.from_dict(json.loads(json.dumps(study.to_dict()))).fixed().keys()
        == study.fixed().keys()
    )
    for run in study.runs()[:4]:
        assert os.sep not in run.name and run.name not in ("", ".", "..")
        StudyFolder(Path("out")).job(run)


@fuzz(9_000)
@given(seeds)
def test_a_study_of_any_fields_is_made_or_refused(seed: int) -> None:
    rng = random.Random(seed)
    values = mutated_value(VALUES, seed)
    if isinstance(values, dict) and rng.random() < 0.4:
        values[rng.choice(tuple(VALUES))] = rng.choice(
            (rng.choice(NAMES), rng.choice(NUMBERS), [rng.choice(NAMES)])
        )
    attempt("Study.from_dict", lambda: _use(Study.from_dict(values)))


@fuzz(9_000)
@given(seed=seeds)
def test_a_study_file_of_any_bytes_is_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, seed: int
) -> None:
    file = tmp_path_factory.getbasetemp() / "study.toml"
    data = mutated(TOML, seed)
    file.write_bytes(data)
    attempt("Study.load", lambda: _use(Study.load(file)))
    assert file.read_bytes() == data


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> StudyFolder:
    return write_study(tmp_path_factory.mktemp("study"), small_study())


@fuzz(300)
@given(seed=seeds)
def test_a_damaged_studys_folder_gives_results_or_refuses(study: StudyFolder, seed: int) -> None:
    rng = random.Random(seed)
    before = content(study.root)
    try:
        for _ in range(rng.choice((1, 1, 2))):
            file = rng.choice(sorted(path for path in study.root.rglob("*") if path.is_file()))
            if file.suffix == ".json" and rng.random() < 0.6:
                _rewrite_json(file, rng)
            elif rng.random() < 0.1:
                file.unlink()
            else:
                file.write_bytes(mutated(file.read_bytes(), rng.randrange(2**32)))
        attempt("study folder", lambda: study.write_results(study.load()))
        attempt("study folder, claimed again", lambda: study.claim(small_study()))
    finally:
        _repair(study.root, before)


def test_the_names_of_runs_cannot_leave_the_folder() -> None:
    for name in NAMES:
        for spec in (RunSpec(name, "full", "lru", "pqn", 0), RunSpec("G", "full", name, "pqn", 0)):
            assert (
                StudyFolder(Path("s")).run(spec).path.parent == Path("s/runs") or "/" in spec.name
            )
