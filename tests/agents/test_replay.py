"""A replay gives back what was put in, and a checkpoint of it is a list of files."""

import json

import pytest
import torch

from arcade_torch.agents.checkpoint import CheckpointError
from arcade_torch.agents.dqn import DQNLoss
from arcade_torch.agents.replay import SequenceReplay
from tests.agents.fakes import ToyNetwork, stream

ROWS, STEPS = 3, 6
RAM = {"memory": 10**9, "mapped": 0}


def windows(count, final_frames="truncated"):
    return [stream(ROWS, STEPS, seed=i).sequences(final_frames) for i in range(count)]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def filled(batches, capacity=100, **options):
    replay = SequenceReplay(capacity, **options)
    for batch in batches:
        replay.add(batch, rank=torch.arange(ROWS).unsqueeze(1).expand(-1, STEPS))
    return replay


@pytest.mark.parametrize("ram", RAM.values(), ids=RAM)
def test_all_sequences_come_back_as_they_were(tmp_path, ram):
    batches = windows(4)
    replay = filled(batches, folder=tmp_path / "replay", ram=ram)
    assert replay.mapped == (ram == 0)
    drawn = replay.sample(12, generator())
    loss = DQNLoss(ToyNetwork(), 0.9, 0.5)
    assert len(replay) == 12 and replay.frames == 12 * STEPS
    for i, batch in enumerate(batches):
        part = drawn[ROWS * i : ROWS * (i + 1)]
        for key in ("pixels", "action", "last_action", "is_init", ("next", "reward"), ("next", "truncated")):
            assert torch.equal(part[key], batch[key])
        assert torch.equal(part["initial_state", "h"], batch["initial_state", "h"])
        assert torch.equal(part["extras", "rank"][:, 0], torch.arange(ROWS))
        mine, theirs = (loss.compute(loss.read(x)) for x in (part, batch))
        torch.testing.assert_close(mine.target, theirs.target, rtol=0, atol=0)  # the frames in the pool too


def test_what_is_stored_does_not_change_with_the_collectors_storage():
    batch = windows(1)[0]
    replay = filled([batch])
    before = replay.sample(ROWS, generator())["pixels"].clone()
    batch["pixels"].zero_()
    batch["next_pool"].pixels.zero_()
    after = replay.sample(ROWS, generator())
    assert torch.equal(after["pixels"], before) and after["next_pool"].pixels.any()


def test_a_draw_is_uniform_and_without_repetition():
    replay = filled(windows(3))
    counts = torch.zeros(9)
    g = generator()
    for _ in range(600):
        frames = replay.sample(4, g)["pixels"].flatten(1).long().sum(1)
        assert len(set(frames.tolist())) == 4
        everything = replay.sample(9, generator())["pixels"].flatten(1).long().sum(1)
        counts += (everything.unsqueeze(1) == frames).any(1)
    torch.testing.assert_close(counts / 600, torch.full((9,), 4 / 9), atol=0.08, rtol=0)


def test_the_oldest_leaves_when_the_capacity_is_reached():
    batches = windows(5)
    replay = filled(batches, capacity=7)  # two windows of three
    assert len(replay) == 6
    assert torch.equal(replay.sample(6, generator())["pixels"], torch.cat([b["pixels"] for b in batches[3:]]))
    with pytest.raises(ValueError, match="cannot draw 7 of 6"):
        replay.sample(7, generator())
    with pytest.raises(ValueError, match="capacity"):
        SequenceReplay(0)


def test_only_frames_that_are_pointed_to_are_drawn():
    replay = filled(windows(2, "all"))
    drawn = replay.sample(2, generator())
    slots = drawn["next", "frame_slot"]
    used = slots[slots >= 0]
    assert sorted(used.tolist()) == list(range(len(drawn["next_pool"].pixels)))


@pytest.mark.parametrize("ram", RAM.values(), ids=RAM)
def test_it_goes_on_from_a_saved_moment(tmp_path, ram):
    batches = windows(6)
    replay = filled(batches[:3], capacity=9, folder=tmp_path, ram=ram)
    state = json.loads(json.dumps(replay.state_dict()))  # names and numbers only
    for batch in batches[3:5]:
        replay.add(batch, rank=torch.zeros(ROWS, STEPS))
    again = SequenceReplay(9, tmp_path, ram)
    again.load_state_dict(state)
    assert torch.equal(again.sample(9, generator())["pixels"], torch.cat([b["pixels"] for b in batches[:3]]))
    for batch in batches[3:5]:
        again.add(batch, rank=torch.zeros(ROWS, STEPS))
    assert again.state_dict() == replay.state_dict()
    mine, theirs = again.sample(5, generator(1)), replay.sample(5, generator(1))
    assert torch.equal(mine["pixels"], theirs["pixels"]) and again.bytes == replay.bytes


@pytest.mark.parametrize("ram", RAM.values(), ids=RAM)
def test_files_stay_as_long_as_a_kept_checkpoint_names_them(tmp_path, ram):
    replay, states = SequenceReplay(ROWS, tmp_path, ram), []  # one window fits
    for batch in windows(6):
        replay.add(batch)
        states.append(replay.state_dict())
        for state in states[-2:]:  # what the last two checkpoints name can be loaded
            SequenceReplay(ROWS, tmp_path, ram).load_state_dict(state)
        assert len(list(tmp_path.iterdir())) <= 3


def test_a_mapped_replay_without_checkpoints_does_not_fill_the_disk(tmp_path):
    replay = filled(windows(6), capacity=6, folder=tmp_path, ram=0)
    assert len(list(tmp_path.iterdir())) == 2 and len(replay) == 6


@pytest.mark.parametrize("how", ["missing", "damaged"])
def test_a_file_that_is_not_whole_is_refused(tmp_path, how):
    replay = filled(windows(2), folder=tmp_path)
    state = replay.state_dict()
    file = sorted(tmp_path.iterdir())[0]
    file.unlink() if how == "missing" else file.write_bytes(file.read_bytes()[:-3] + b"abc")
    with pytest.raises(CheckpointError, match=how):
        SequenceReplay(100, tmp_path).load_state_dict(state)


def test_frames_of_another_size_than_those_at_hand_are_refused_in_one_line():
    first, second = windows(2)
    replay = filled([first])
    second["pixels"] = second["pixels"][:, :, :-1]
    with pytest.raises(CheckpointError, match=r"replay holds frames of \d+x\d+ pixels and the encoder now stores"):
        replay.add(second)
    assert len(replay) == first.batch_size[0]
