"""The line that says how a run stands."""

from io import StringIO

from arcade_torch.tools.progress import TrainBar, standing

ROW = {
    "frames": 4_000,
    "total_frames": 16_000,
    "train_return_ewm": 0.25,
    "train_return_last": 0.5,
    "eval_return": None,
    "loss": 0.0123,
    "epsilon": 0.4,
    "entropy": None,
    "lr": 5e-5,
}


def test_a_line_shows_speed_time_left_returns_loss_exploration_and_step_size() -> None:
    stream = StringIO()
    with TrainBar("run", stream) as bar:
        bar.speed.update(-4.0, 0)  # so that there is a speed at the first row
        bar.show(ROW)
    line = stream.getvalue()
    assert line.startswith("4,000 of 16,000 frames, ") and " frames/s, " in line and " left; return 0.250, " in line
    assert line.endswith("of last episodes 0.500, loss 0.0123, epsilon 0.40, lr 5.0e-05\n")


def test_a_policy_that_is_sampled_shows_its_entropy_and_the_greedy_return_appears_when_there_is_one() -> None:
    row = {**ROW, "epsilon": None, "entropy": 1.5, "eval_return": -0.125}
    assert "greedy -0.125, loss 0.0123, entropy 1.50, lr" in standing(row)
    assert standing({"frames": 1, "total_frames": 2, "lr": 1e-3}) == "lr 1.0e-03"
