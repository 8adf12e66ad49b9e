"""Real studies that are killed, starved and doubled, minutes each; see `arcade_torch.tools.bench.resilience`."""

from collections.abc import Callable
from pathlib import Path

import pytest

from arcade_torch.tools.bench import resilience
from arcade_torch.tools.bench.resilience import Bench

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """Studies of twelve runs, and one that nothing disturbed, made once."""
    return Bench(tmp_path_factory.mktemp("resilience"), seeds=1)


@pytest.mark.parametrize(
    "part",
    [
        pytest.param(lambda bench: resilience.engines(bench), id="every engine gives the same to the bit"),
        pytest.param(lambda bench: resilience.worker(bench), id="a killed worker costs nothing"),
        pytest.param(
            lambda bench: resilience.head(bench), id="a killed Ray cluster costs nothing", marks=pytest.mark.ray
        ),
        pytest.param(lambda bench: resilience.kills(bench, 6), id="kills at random moments cost nothing"),
        pytest.param(lambda bench: resilience.disk(bench), id="a full disk costs nothing"),
        pytest.param(lambda bench: resilience.together(bench), id="three studies share a folder"),
    ],
)
def test_a_study_survives(part: Callable[[Bench], tuple[str, bool]], bench: Bench) -> None:
    try:
        told, good = part(bench)
    except PermissionError as error:
        pytest.skip(str(error))
    assert good, told


def test_a_fingerprint_sees_a_single_bit_of_the_weights_and_no_clock(bench: Bench, tmp_path: Path) -> None:
    import shutil

    before = bench.undisturbed()
    root = Path(shutil.copytree(bench.root("inline"), tmp_path / "out"))
    for file in root.glob("runs/*/metrics.csv"):
        rows = [line.split(",") for line in file.read_text().splitlines()]
        place = rows[0].index("seconds")
        file.write_text("\n".join(",".join([*row[:place], row[place] + "0", *row[place + 1 :]]) for row in rows[1:]))
        file.write_text(",".join(rows[0]) + "\n" + file.read_text() + "\n")
    assert resilience.fingerprint(root) == before
    weights = sorted(root.glob("runs/*/checkpoints/frames-*/weights.safetensors"))[-1]
    data = bytearray(weights.read_bytes())
    data[-1] ^= 1
    weights.write_bytes(data)
    changed = {name for name, value in resilience.fingerprint(root).items() if value != before[name]}
    assert changed == {weights.parents[2].name}
