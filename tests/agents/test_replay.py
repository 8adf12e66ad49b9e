"""A replay gives back what was put in, and a checkpoint of it is a list of files."""

import json

import pytest
import torch

from arcade_torch.agents import CheckpointError, DQNLoss, SequenceReplay
from tests.agents.fakes import look_into, stream, toy_network

ROWS, STEPS = 3, 6


def windows(count):
    """Windows with the same number of places, as the collector gives them."""
    batches = []
    for i in range(count):
        batch = stream(ROWS, STEPS, seed=i).sequences()
        spare = STEPS - batch["final_mask"].shape[1]
        for key, fill in (("final_pixels", 255), ("final_index", STEPS - 1), ("final_mask", False)):
            value = batch[key]
            batch[key] = torch.cat(
                (value, torch.full_like(value[:, :1], fill).repeat_interleave(spare, 1)), 1
            )
        batches.append(batch)
    return batches


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def filled(batches, capacity=100, **options):
    replay = SequenceReplay(capacity, **options)
    for batch in batches:
        replay.add(batch)
    return replay


def everything(replay):
    return replay.sample(len(replay), generator())


def test_all_sequences_come_back_as_they_were(tmp_path):
    batches = windows(4)
    replay = filled(batches, folder=tmp_path / "replay")
    assert len(replay) == 12 and replay.frames == 12 * STEPS
    drawn, loss = everything(replay), DQNLoss(toy_network())
    assert (drawn == torch.cat(batches)).all()
    assert set(drawn.keys(True, True)) == set(batches[0].keys(True, True))
    for i, batch in enumerate(batches):
        mine, theirs = (look_into(loss, x)[1] for x in (drawn[ROWS * i : ROWS * (i + 1)], batch))
        assert torch.equal(mine, theirs)


def test_what_is_stored_does_not_change_with_the_collectors_storage():
    batch = windows(1)[0]
    replay = filled([batch])
    before = everything(replay)
    batch["pixels"].zero_()
    batch["final_pixels"].zero_()
    assert (everything(replay) == before).all() and before["pixels"].any()


def test_a_draw_is_uniform_and_without_repetition():
    replay, g = filled(windows(3)), generator()
    numbers = everything(replay)["pixels"].flatten(1).long().sum(1)
    counts = torch.zeros(9)
    for _ in range(600):
        frames = replay.sample(4, g)["pixels"].flatten(1).long().sum(1)
        assert len(set(frames.tolist())) == 4
        counts += (numbers.unsqueeze(1) == frames).any(1)
    torch.testing.assert_close(counts / 600, torch.full((9,), 4 / 9), atol=0.08, rtol=0)


def test_the_oldest_leaves_when_the_capacity_is_reached():
    batches = windows(5)
    replay = filled(batches, capacity=7)  # two windows of three
    assert len(replay) == 6 and (everything(replay) == torch.cat(batches[3:])).all()
    assert (
        everything(filled(batches, capacity=1)) == batches[4]
    ).all()  # the newest window stays whole
    with pytest.raises(ValueError, match=r"count must be from 1 to the 6 sequences at hand; got 7"):
        replay.sample(7, generator())
    with pytest.raises(ValueError, match="capacity"):
        SequenceReplay(0)


def test_as_many_of_the_oldest_leave_as_the_newest_needs_room():
    batches = windows(5)
    ones = [batch[:1] for batch in batches[:4]]
    replay = filled([*ones, batches[4]], capacity=4)
    assert len(replay) == 4
    assert (everything(replay) == torch.cat([ones[3], batches[4]])).all()


def test_entries_that_share_memory_are_stored():
    batch = windows(1)[0]
    batch["again"] = batch["action"]
    drawn = everything(filled([batch]))
    assert torch.equal(drawn["again"], batch["action"])


def test_it_goes_on_from_a_saved_moment(tmp_path):
    batches = windows(6)
    replay = filled(batches[:4], capacity=9, folder=tmp_path)  # the first has left
    state = json.loads(json.dumps(replay.state_dict()))  # names and numbers only
    for batch in batches[4:]:
        replay.add(batch)
    again = SequenceReplay(9, tmp_path)
    again.load_state_dict(state)
    assert (everything(again) == torch.cat(batches[1:4])).all()
    for batch in batches[4:]:
        again.add(batch)
    mine, theirs = again.sample(5, generator(1)), replay.sample(5, generator(1))
    assert (mine == theirs).all()
    SequenceReplay(9, tmp_path).load_state_dict(
        state
    )  # until the next checkpoint one may have to begin here again
    assert again.state_dict() == replay.state_dict()
    replay.load_state_dict(state)  # and in its own place
    assert (everything(replay) == torch.cat(batches[1:4])).all()


def test_files_stay_as_long_as_a_kept_checkpoint_names_them(tmp_path):
    replay, states = SequenceReplay(ROWS, tmp_path), []  # one window fits
    for batch in windows(6):
        replay.add(batch)
        states.append(replay.state_dict())
        for state in states[
            -3:
        ]:  # of the newest, which may not be written yet, and the two before it
            SequenceReplay(ROWS, tmp_path).load_state_dict(state)
        assert len(list(tmp_path.iterdir())) <= 3


def test_a_replay_without_checkpoints_does_not_fill_the_disk(tmp_path):
    replay = filled(windows(6), capacity=6, folder=tmp_path)
    assert len(list(tmp_path.iterdir())) == 2 and len(replay) == 6


@pytest.mark.parametrize("how", ["missing", "damaged"])
def test_a_file_that_is_not_whole_is_refused(tmp_path, how):
    state = filled(windows(2), folder=tmp_path).state_dict()
    file = sorted(tmp_path.iterdir())[0]
    file.unlink() if how == "missing" else file.write_bytes(file.read_bytes()[:-3] + b"abc")
    with pytest.raises(CheckpointError, match=how):
        SequenceReplay(100, tmp_path).load_state_dict(state)


def test_a_file_that_is_damaged_between_two_checkpoints_is_whole_in_neither(tmp_path):
    replay = filled(windows(2), folder=tmp_path)
    states = [replay.state_dict()]
    resumed = SequenceReplay(100, tmp_path)
    resumed.load_state_dict(states[0])
    file = sorted(tmp_path.iterdir())[0]
    file.write_bytes(file.read_bytes()[:-3] + b"abc")
    states += [replay.state_dict(), resumed.state_dict()]
    for state in states:
        with pytest.raises(CheckpointError, match="damaged"):
            SequenceReplay(100, tmp_path).load_state_dict(state)


def test_outcomes_of_another_type_are_refused():
    first, second = windows(2)
    replay = filled([first])
    second["next", "reward"] = second["next", "reward"].double()
    with pytest.raises(CheckpointError, match="holds other frames than the windows before it"):
        replay.add(second)
    assert (everything(replay) == first).all()


def test_frames_of_another_size_than_those_at_hand_are_refused_in_one_line():
    first, second = windows(2)
    replay = filled([first])
    second["pixels"] = second["pixels"][:, :, :-1]
    with pytest.raises(
        CheckpointError,
        match=r"holds frames \(2, 2, 3\), the network now stores \(1, 2, 3\): train again, or go on "
        "with the version that began the run",
    ):
        replay.add(second)
    assert len(replay) == ROWS
