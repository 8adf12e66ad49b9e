"""An entry is what its checkpoints give; a falsified one is refused in one line that says where."""

import copy
import json
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from arcade_torch.agents import EvalResult, evaluate, load
from arcade_torch.tools.board import check as checks
from arcade_torch.tools.board import submit as submits
from arcade_torch.tools.board.check import CheckRecord, check, read_record, write_record
from arcade_torch.tools.board.entry import BoardRun, EntryRefusedError, entry_of
from arcade_torch.tools.board.evaluation import Evaluator, Played, digest
from arcade_torch.tools.board.submit import submit
from tests.tools.board.boards import GAME, SHORT, WORDS, plain_entry, write_pair, write_run

Plain = dict[str, Any]


def no_episodes(*arguments: Any) -> Any:
    raise AssertionError("an agent was evaluated")


@pytest.fixture(scope="module", autouse=True)
def _compiled_once() -> Iterator[None]:
    """All evaluators of this file share their environments."""
    envs: dict[Any, Any] = {}
    make = Evaluator._env

    def shared(self: Evaluator, config: Any) -> Any:
        if config.env not in envs:
            envs[config.env] = make(self, config)
        return envs[config.env]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Evaluator, "_env", shared)
        yield


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    write_pair(folder, seed=1)
    write_pair(folder, seed=2)
    return folder


@pytest.fixture(scope="module")
def honest(runs: Path) -> Plain:
    return plain_entry(runs)


def write(folder: Path, plain: Plain) -> Path:
    file = folder / "entry.json"
    file.write_text(json.dumps(plain))
    return file


def refusal(file: Path, runs: Path, **options: Any) -> str:
    with pytest.raises(EntryRefusedError) as caught:
        check(file, runs, protocol=SHORT, **options)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_an_honest_entry_agrees_to_the_bit(runs: Path, honest: Plain, tmp_path: Path) -> None:
    record = check(write(tmp_path, honest), runs, protocol=SHORT)
    assert (record.runs, record.of, record.equal) == (4, 4, 4)
    assert record.largest_difference == 0.0
    assert record.weights == "kept"


def test_an_entry_says_all_that_the_protocol_asks_for(honest: Plain) -> None:
    cells = {(run["game"], run["twin"], run["seed"]) for run in honest["runs"]}
    assert cells == {(GAME, twin, seed) for twin in ("full", "partial") for seed in (1, 2)}
    assert honest["evaluation"] == {"episodes": 4, "seed": SHORT.seed}
    assert honest["parameters"] > 0 and honest["state_bytes"] > 0 and honest["frames"] == 512
    assert {"torch", "jax", "commit", "processor"} <= set(honest["made_with"])
    assert honest["observations"]["acting"] == ["is_init", "last_action", "pixels"]
    assert {run["seconds"] for run in honest["runs"]} == {2.0}


def test_an_agent_plays_the_episodes_of_the_protocol(
    runs: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An agent that was not trained plays all seeds alike: its score does not tell which."""
    checkpoint = next(runs.glob(f"{GAME}-partial-mingru-1/checkpoints/frames-*"))
    results = list[Any]()

    def evaluate_once(agent: Any, twin: str, seed: int, env: Any) -> Any:
        assert (twin, seed, env.num_envs) == ("full", SHORT.seed, SHORT.episodes)
        lengths = evaluate(agent, "full", seed=seed, env=env).lengths
        results.append(EvalResult(np.array([0.0, 1.0, 1.0, 3.0], np.float32), lengths))
        return results[0]

    monkeypatch.setattr("arcade_torch.agents.evaluation.evaluate", evaluate_once)
    found = Evaluator(SHORT).play(checkpoint, "full")  # trained on the other twin
    (result,) = results
    assert found.returns_sha256 == digest(result.returns, result.lengths)
    assert found.score == 1.25 and found.std == pytest.approx(result.std) != 0
    assert found.half_width == pytest.approx(3.182446 * np.std(result.returns, ddof=1) / 2)
    state = load(checkpoint).initial_state(1).values(include_nested=True, leaves_only=True)
    assert found.state_bytes == sum(4 * part.numel() for part in state) > 0


def set_score(plain: Plain) -> None:
    plain["runs"][1]["score"] += 0.5


def set_score_and_its_hash(plain: Plain) -> None:
    plain["runs"][1] |= {"score": 0.9, "std": 0.1, "returns_sha256": "0" * 64}


def set_std(plain: Plain) -> None:
    plain["runs"][1]["std"] += 0.01


def set_evaluation_seed(plain: Plain) -> None:
    plain["evaluation"]["seed"] = 7


def set_episodes(plain: Plain) -> None:
    plain["evaluation"]["episodes"] = 2


def set_training_seed(plain: Plain) -> None:
    for run in plain["runs"]:
        run["settings"]["seed"] = run["seed"] = run["seed"] + 5


def set_seed_of_the_cell_alone(plain: Plain) -> None:
    for run in plain["runs"]:
        run["seed"] += 5


def set_checkpoint(plain: Plain) -> None:
    plain["runs"][3]["weights_sha256"] = "0" * 64


def remove_cell(plain: Plain) -> None:
    del plain["runs"][1]


def repeat_cell(plain: Plain) -> None:
    plain["runs"].append(plain["runs"][0])


def set_game(plain: Plain) -> None:
    for run in plain["runs"]:
        run["game"] = "PairsEasy-v0"


def set_protocol(plain: Plain) -> None:
    plain["protocol"] = 2


def show_the_state(plain: Plain) -> None:
    plain["observations"]["training"].append("state")


def play_by_the_state(plain: Plain) -> None:
    plain["observations"]["acting"].append("state")


def hide_the_observations(plain: Plain) -> None:
    plain["observations"] = {"acting": ["pixels"]}


def set_rules(plain: Plain) -> None:
    plain["environments"]["rules"] = "reference"


def set_size(plain: Plain) -> None:
    plain["environments"]["obs_size"] = 256


def set_memory(plain: Plain) -> None:
    plain["memory"] = "lru"


def set_algorithm(plain: Plain) -> None:
    plain["algorithm"] = "ppo"


def set_options(plain: Plain) -> None:
    plain["settings"]["env_options.mine_reward"] = 0.0


def train_the_pomdp_on_the_mdp(plain: Plain) -> None:
    for run in plain["runs"]:
        run["settings"]["observability"] = "full"


def set_gamma(plain: Plain) -> None:
    plain["settings"]["pqn.gamma"] = 0.5


def set_parameters(plain: Plain) -> None:
    plain["parameters"] = 12


def set_one_parameter_more(plain: Plain) -> None:
    plain["parameters"] += 1


def set_state(plain: Plain) -> None:
    plain["state_bytes"] = 4


FALSIFIED: dict[Callable[[Plain], None], str] = {
    set_score: f"score of {GAME} partial, seed 1: evaluated again it is",
    set_score_and_its_hash: f"score of {GAME} partial, seed 1: evaluated again it is",
    set_std: f"std of {GAME} partial, seed 1: evaluated again it is",
    set_evaluation_seed: "evaluation.seed is 7; the protocol of this version demands 1000000",
    set_episodes: "evaluation.episodes is 2",
    set_training_seed: f"no run of mingru on {GAME} full, seed 6 lies below",
    set_seed_of_the_cell_alone: f"settings of {GAME} full, seed 6: seed is 1, the entry says 6",
    set_checkpoint: f"checkpoint of {GAME} partial, seed 2: the weights below",
    remove_cell: f"missing cell: {GAME} partial, seed 1",
    repeat_cell: f"two runs of one cell: {GAME} full, seed 1",
    set_game: "the game PairsEasy-v0 is none of this package, and the board compares agents on",
    set_protocol: "protocol is 2; the protocol of this version demands 1",
    show_the_state: "privileged observation in training: 'state'",
    play_by_the_state: "privileged observation in acting: 'state'",
    hide_the_observations: "observations.training does not say what the agent reads",
    set_rules: "environments.rules is reference",
    set_size: "environments.obs_size is 256",
    set_memory: "memory is 'mingru', the entry says 'lru'",
    set_algorithm: "algorithm is 'pqn', the entry says 'ppo'",
    set_options: "env_options make another task",
    train_the_pomdp_on_the_mdp: "observability is 'full', the entry says 'partial'",
    set_gamma: "differs in pqn.gamma (0.99 != 0.5)",
    set_parameters: f"parameters of {GAME} full, seed 1",
    set_one_parameter_more: "is the largest of the runs, the entry says",
    set_state: f"state_bytes of {GAME} full, seed 1",
}


@pytest.mark.parametrize("falsify", FALSIFIED, ids=lambda change: change.__name__)
def test_a_falsified_entry_is_refused_in_a_line_that_says_where(
    falsify: Callable[[Plain], None], runs: Path, honest: Plain, tmp_path: Path
) -> None:
    plain = copy.deepcopy(honest)
    falsify(plain)
    assert FALSIFIED[falsify] in refusal(write(tmp_path, plain), runs)


def test_agents_of_some_games_may_be_smaller_than_the_largest(
    runs: Path, honest: Plain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The preset small has no predictor in Navigator: such an entry was refused."""
    play = checks.Evaluator.play
    sizes = iter((honest["parameters"] - 100, *[honest["parameters"]] * 3))

    def play_smaller(self: Any, checkpoint: Path, twin: str) -> Any:
        return replace(play(self, checkpoint, twin), parameters=next(sizes))

    monkeypatch.setattr(checks.Evaluator, "play", play_smaller)
    assert check(write(tmp_path, honest), runs, protocol=SHORT).equal == 4


def test_a_part_of_an_entry_need_not_have_its_largest_agent(
    runs: Path, honest: Plain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    play = checks.Evaluator.play

    def play_smaller(self: Any, checkpoint: Path, twin: str) -> Any:
        return replace(play(self, checkpoint, twin), parameters=honest["parameters"] - 100)

    monkeypatch.setattr(checks.Evaluator, "play", play_smaller)
    assert check(write(tmp_path, honest), runs, 1, SHORT).equal == 1
    assert "is the largest of the runs" in refusal(write(tmp_path, honest), runs)


def test_the_folder_of_a_run_is_the_one_with_its_weights_then_one_that_was_trained(
    honest: Plain, tmp_path: Path
) -> None:
    """Beside them lie runs of the same settings that stopped, and a damaged one."""
    entry = entry_of(honest)
    run = entry.runs[0]

    def copy_of(name: str) -> Path:
        return write_run(tmp_path / name, observability=run.twin, seed=run.seed)

    stopped, other = copy_of("a"), copy_of("b")
    shutil.rmtree(next(stopped.glob("checkpoints/frames-*")))
    weights = next(other.rglob("weights.safetensors"))
    weights.write_bytes(weights.read_bytes()[:-1] + b"x")
    (copy_of("c") / "config.json").write_text("{")
    assert checks.find_folders(entry, [run], tmp_path) == {run.cell: other}
    own = copy_of("d")
    assert checks.find_folders(entry, [run], tmp_path) == {run.cell: own}


def test_which_part_is_drawn_cannot_be_foreseen(
    runs: Path, honest: Plain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever knows it needs to be honest in that part alone."""
    played = set()

    def play_none(entry: Any, chosen: Any, *rest: Any) -> Any:
        played.add(tuple(run.cell for run in chosen))
        return chosen, 0

    monkeypatch.setattr(checks, "_play_again", play_none)
    for _ in range(12):
        random.seed(0)
        check(write(tmp_path, honest), runs, 2, SHORT)
    assert len(played) > 1


def test_other_weights_are_refused_before_they_are_loaded(
    honest: Plain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path / "runs", seed=1)
    write_pair(tmp_path / "runs", seed=2)
    weights = sorted((tmp_path / "runs").rglob("weights.safetensors"))[0]
    weights.write_bytes(weights.read_bytes()[:-4] + b"\0\0\0\1")

    def load(*arguments: object) -> None:
        raise AssertionError("weights of another hash were loaded")

    monkeypatch.setattr(checks.Evaluator, "play", load)
    message = refusal(write(tmp_path, honest), tmp_path / "runs")
    assert f"checkpoint of {GAME} full, seed 1: the weights below" in message


def test_on_the_same_machine_and_versions_a_score_has_to_be_equal_to_the_bit(
    runs: Path, honest: Plain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A difference that is allowed elsewhere is refused there."""
    plain = copy.deepcopy(honest)
    plain["runs"][0] |= {"score": plain["runs"][0]["score"] + 1e-9, "returns_sha256": "0" * 64}
    here = {"commit": "abc", "processor": "one"}
    monkeypatch.setattr(checks, "made_with", lambda: here)
    plain["made_with"] = here | {"processor": "two"}
    record = check(write(tmp_path, plain), runs, protocol=SHORT)
    assert record.equal == 3 and 0 < record.largest_difference < 1e-8
    plain["made_with"] = here
    assert "equal to the bit: same commit" in refusal(write(tmp_path, plain), runs)
    for unknown in ({"commit": "abc+changes"}, {"commit": ""}, {"processor": ""}):
        monkeypatch.setattr(checks, "made_with", lambda unknown=unknown: here | unknown)
        plain["made_with"] = here | unknown
        assert check(write(tmp_path, plain), runs, protocol=SHORT).equal == 3


def check_one(difference: float, half_width: float, is_same: bool, **changes: Any) -> bool:
    """Whether a run is equal to the bit that played otherwise by so much."""
    score = 0.25
    sha256 = "1" * 64 if difference else "0" * 64
    played = Played(score + difference, 0.1, half_width, sha256, 10, 8, ("pixels",))
    hashes = {"returns_sha256": "0" * 64, "weights_sha256": "0" * 64}
    run = BoardRun(GAME, "full", 1, score=score, std=0.1, seconds=1.0, **hashes)
    sizes: Any = SimpleNamespace(parameters=10, state_bytes=8)
    return checks._check_played(sizes, run, replace(played, **changes), is_same)


def test_elsewhere_a_score_may_differ_by_half_its_interval_or_the_least_tolerance() -> None:
    assert check_one(0, 0.0, is_same=True) and check_one(0, 0.0, is_same=False)
    for sign in (-1, 1):
        for half_width, tolerance in ((0.1, 0.1), (0.001, 0.002), (0.0, 0.002)):
            assert not check_one(0.99 * sign * tolerance, half_width, is_same=False)
            with pytest.raises(EntryRefusedError, match=f"to be within {tolerance:.4f}"):
                check_one(1.01 * sign * tolerance, half_width, is_same=False)
            with pytest.raises(EntryRefusedError, match="to be equal to the bit"):
                check_one(1e-12 * sign, half_width, is_same=True)


def test_equal_scores_of_other_episodes_are_not_equal_to_the_bit() -> None:
    assert not check_one(0, 0.1, is_same=False, returns_sha256="2" * 64)
    with pytest.raises(EntryRefusedError, match="to be equal to the bit"):
        check_one(0, 0.1, is_same=True, returns_sha256="2" * 64)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observations": ("pixels", "state")}, "privileged observation in .*, acting: 'state'"),
        ({"parameters": 11}, "parameters of .*: 11, the entry says 10"),
        ({"state_bytes": 9}, "state_bytes of .*: 9, the entry says 8"),
        ({"std": 0.2}, "std of .*: evaluated again it is 0.2, the entry says 0.1"),
    ],
)
def test_what_was_played_is_held_to_the_entry(changes: Plain, message: str) -> None:
    assert check_one(0, 0.1, is_same=False, parameters=9, state_bytes=7)
    with pytest.raises(EntryRefusedError, match=message):
        check_one(0, 0.1, is_same=False, **changes)


def test_a_part_is_drawn_and_only_that_is_looked_for(
    runs: Path, honest: Plain, tmp_path: Path
) -> None:
    """The folders of the others need not be there."""
    file = write(tmp_path, honest)
    places = [checks._drawn(range(40), 3, random.Random(seed)) for seed in range(5)]
    assert all(len(set(drawn)) == 3 for drawn in places)
    assert len({tuple(drawn) for drawn in places}) == 5
    assert len(checks._drawn(range(4), 3, random.Random(0))) == 3
    for count in (0, 4, 5):
        assert checks._drawn(range(4), count, random.Random(0)) == [0, 1, 2, 3]
    folder = runs / f"{GAME}-partial-mingru-2"
    generators = [random.Random(seed) for seed in range(40)]
    drawing_last = [
        seed for seed in range(40) if checks._drawn(range(4), 1, generators[seed]) == [3]
    ]
    record = check(file, folder, 1, SHORT, generator=random.Random(drawing_last[0]))
    assert (record.runs, record.of) == (1, 4)


def test_a_record_is_of_one_very_file(runs: Path, honest: Plain, tmp_path: Path) -> None:
    file = write(tmp_path, honest)
    record = check(file, runs, 1, SHORT)
    write_record(file, record)
    assert read_record(file) == record
    plain = copy.deepcopy(honest)
    plain["note"] = "changed since"
    assert read_record(write(tmp_path, plain)) is None
    (tmp_path / "checks" / "entry.json").write_text('{"runs": -1}')
    with pytest.raises(EntryRefusedError, match="is no record of a check"):
        read_record(file)


def test_a_record_cannot_claim_more_than_it_checked() -> None:
    values: Plain = {
        "entry_sha256": "0" * 64,
        "date": "2026-11-27",
        "runs": 5,
        "of": 4,
        "equal": 4,
        "largest_difference": 0.0,
        "weights": "kept",
        "made_with": {},
    }
    with pytest.raises(ValueError, match=r"check\.runs must be"):
        CheckRecord(**values)
    with pytest.raises(ValueError, match=r"check\.equal must be"):
        CheckRecord(**values | {"runs": 3})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observability": "mixed"}, "privileged observation"),
        ({"memory": "gru"}, "the runs are 2 agents"),
        ({"env": "CountRecallEasy-v0", "total_frames": 1024}, "runs of 1,024 and 512 frames"),
        ({"env": "CountRecallEasy-v0"}, r"missing cell: CountRecallEasy-v0 partial, seed 0"),
        ({"env": "CountRecallEasy-v0", "amp": True}, "was trained with other amp than"),
        (
            {"observability": "partial", "pqn": {"gamma": 0.5}},
            "the twins of mingru on MineSweeperEasy-v0 differ in pqn.gamma",
        ),
    ],
)
def test_runs_that_are_no_entry_are_refused_before_they_are_evaluated(
    changes: Plain, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other_twin = changes.get("observability") == "partial"
    if other_twin:
        write_run(tmp_path, observability="full")
    else:
        write_pair(tmp_path)
    write_run(tmp_path, **({"observability": "full"} | changes))
    monkeypatch.setattr(submits.Evaluator, "play", no_episodes)
    with pytest.raises(ValueError, match=message):
        submit([tmp_path], WORDS, protocol=SHORT)


@pytest.mark.parametrize("words", [{"name": "../x"}, {"commit": "main"}, {"url": "http://x"}])
def test_words_that_no_entry_has_are_refused_before_runs_are_evaluated(
    words: Plain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path)
    monkeypatch.setattr(submits.Evaluator, "play", no_episodes)
    with pytest.raises(ValueError, match=f"{next(iter(words))} must be"):
        submit([tmp_path], replace(WORDS, **words), protocol=SHORT)


def test_runs_without_the_checkpoint_of_their_end_are_refused_before_any_is_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path)
    last = max(tmp_path.glob("*/checkpoints/frames-*"))
    last.rename(last.with_name("frames-000000000256"))  # an earlier one is no agent of the end
    monkeypatch.setattr(submits.Evaluator, "play", no_episodes)
    with pytest.raises(EntryRefusedError, match="has no checkpoint frames-"):
        submit([tmp_path], WORDS, protocol=SHORT)


def test_an_agent_that_turns_out_to_read_the_state_makes_no_entry(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path)
    read = iter((("pixels",), ("pixels", "state")))  # one of the runs alone

    def play(self: Any, checkpoint: Path, twin: str) -> Played:
        return Played(0.0, 0.0, 0.0, "0" * 64, 1, 1, next(read))

    monkeypatch.setattr(submits.Evaluator, "play", play)
    with pytest.raises(EntryRefusedError, match="privileged observation in training: 'state'"):
        submit([tmp_path], WORDS, protocol=SHORT)


def test_an_entry_of_several_games_says_the_largest_of_each_and_keeps_the_settings_of_every_game(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_pair(tmp_path)
    write_pair(tmp_path, env="CountRecallEasy-v0", pqn={"gamma": 0.5})
    sizes = iter((1, 4, 3, 2))

    def play(self: Any, checkpoint: Path, twin: str) -> Played:
        size = next(sizes)
        assert f"-{twin}-" in str(checkpoint)
        read = ("pixels", "last_action") if size == 4 else ("pixels",)
        return Played(0.0, 0.0, 0.0, "0" * 64, size, 10 * size, read)

    monkeypatch.setattr(submits.Evaluator, "play", play)
    entry = submit([tmp_path], WORDS, protocol=SHORT)
    assert (entry.parameters, entry.state_bytes) == (4, 40)
    assert entry.observations["acting"] == ["last_action", "pixels"]
    gammas = {run.game: entry.config(run).pqn.gamma for run in entry.runs}
    assert gammas == {GAME: 0.99, "CountRecallEasy-v0": 0.5}
