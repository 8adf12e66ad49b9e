"""The notebooks: every cell runs, what they say of their figures holds, and what is committed came
from the sources.
"""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.few import few

FOLDER = Path(__file__).resolve().parents[1] / "examples/notebooks"


def _build() -> Any:
    spec = importlib.util.spec_from_file_location("build_notebooks", FOLDER / "build.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


build = _build()
SHORT = 128  # frames, with the preset that learns nothing in seconds
WITH_AGENTS = ("saliency", "recall_density", "counterfactual", "contamination", "attribution")
"""Notebooks with agents of the package, which train nothing."""
WINDOW = 1280  # the least that the collector of torchrl_pipeline gives


@pytest.fixture(autouse=True)
def forget_registered_memories(monkeypatch: pytest.MonkeyPatch) -> None:
    from arcade_torch.models import registry

    monkeypatch.setattr(registry, "_FACTORIES", dict(registry._FACTORIES))


def run(name: str, frames: int | None) -> dict[str, Any]:
    """The namespace of a notebook after its last cell; some cell has drawn something."""
    if name == "attribution":
        pytest.importorskip("captum.attr", reason="needs Captum: pip install '.[captum]'")
    cells = build.read_cells(FOLDER / f"{name}.py")
    if frames is not None:
        cells = [cell._replace(text=cell.text.replace('"small"', '"smoke"')) for cell in cells]
    namespace, outputs = build.run_cells(cells, frames)
    assert any("image/png" in item.get("data", {}) for found in outputs for item in found)
    return dict(namespace)


def laws(name: str, namespace: dict[str, Any]) -> None:
    """What each notebook says that holds however little an agent was trained."""
    if name == "saliency":
        np.testing.assert_allclose(namespace["shares"]["no memory, POMDP"], [0, 0, 0, 0, 1])
    if name == "recall_density":
        np.testing.assert_allclose(namespace["found"]["no memory, POMDP"].mass(5), [0, 0, 0, 0, 1])
    if name == "counterfactual":
        effect = namespace["effects"]["no memory, POMDP"]
        assert effect.memory_reliance().value == 0 == np.nanmax(effect.profile()[1:])
    if name == "attribution":
        shares = namespace["shares"]
        assert all(share.shape == (namespace["steps"],) for share in shares.values())
        for name in ("gradient", "integrated gradients", "occlusion"):
            assert shares[name].sum() == pytest.approx(1)
    if name == "own_memory":
        shares = namespace["shares"]
        assert shares[0] > 0 and shares[-1] > 0 and (shares[1:-1] == 0).all()
    if name == "contamination":
        assert np.nanmax(namespace["found"]["no memory"].mean("flip")[:, 1:]) == 0
    if name == "torchrl_pipeline":
        assert (
            namespace["density"].mass(5).sum() == pytest.approx(1)
            and namespace["density"].mass(5)[0] > 0
        )


def claims(name: str, namespace: dict[str, Any]) -> None:
    """What each notebook says of agents that have learned."""
    if name == "saliency":
        shares = namespace["shares"]
        assert shares["LRU, POMDP"][0] > 0.02 > shares["LRU, MDP"][0]
    if name == "recall_density":
        past = {name: 1 - density.mass(5)[-1] for name, density in namespace["found"].items()}
        assert 0.8 > past["LRU, POMDP"] > 2 * past["LRU, MDP"] > 0
    if name == "counterfactual":
        profile = namespace["effects"]["LRU, POMDP"].profile(differing=True)
        assert profile[-1] > 0.9 and np.nanmax(profile[:-1], initial=0) < 0.1
        assert namespace["effects"]["LRU, MDP"].memory_reliance().value < 0.1
    if name == "attribution":
        exchanged = namespace["shares"]["exchange"]
        assert exchanged[0] > 0.9 and exchanged[1:].max() < 0.1
        assert namespace["shares"]["gradient"][1:].sum() > 0.2
    if name == "own_memory":
        assert namespace["result"].evaluation.mean > 0.9
    if name == "contamination":
        assert namespace["found"]["LRU"].mean("flip")[-1, 1] > 0.05
    if name == "torchrl_pipeline":
        assert namespace["returns"][-1] > 0.8


@pytest.mark.parametrize("name", few(build.NAMES, often=set(build.NAMES) - {"contamination"}))
def test_every_cell_runs(name: str) -> None:
    """Those that train learn nothing in so few frames; the others show what they say."""
    namespace = run(name, WINDOW if name == "torchrl_pipeline" else SHORT)
    laws(name, namespace)
    if name in WITH_AGENTS:
        claims(name, namespace)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(build.NAMES) - set(WITH_AGENTS)))
def test_the_long_form_shows_what_it_says(name: str) -> None:
    namespace = run(name, None)
    laws(name, namespace)
    claims(name, namespace)


@pytest.mark.parametrize("name", build.NAMES)
def test_the_committed_notebook_was_built_from_its_source(name: str) -> None:
    file = FOLDER / f"{name}.ipynb"
    made = json.loads(file.read_text())
    cells = [build.Cell(cell["cell_type"], "".join(cell["source"])) for cell in made["cells"]]
    assert cells == build.read_cells(FOLDER / f"{name}.py"), (
        f"run: python examples/notebooks/build.py {name}"
    )
    assert any(cell.get("outputs") for cell in made["cells"]) and file.stat().st_size < 200_000


def test_a_source_without_a_title_is_refused(tmp_path: Path) -> None:
    (tmp_path / "x.py").write_text("# %%\n1\n")
    with pytest.raises(ValueError, match="no docstring"):
        build.read_cells(tmp_path / "x.py")


def test_cells_become_a_notebook_with_what_they_printed_and_drew(tmp_path: Path) -> None:
    source = '"""# T"""\n\n# %%\nimport matplotlib.pyplot as plt\nFRAMES = 5  # n\nprint(FRAMES)\n_ = plt.figure()\n'
    (tmp_path / "x.py").write_text(source + "# %% [markdown]\n# a\n#\n# b\n")
    cells = build.read_cells(tmp_path / "x.py")
    assert [cell.kind for cell in cells] == ["markdown", "code", "markdown"] and cells[
        2
    ].text == "a\n\nb"
    _, outputs = build.run_cells(cells, 7)
    made = json.loads(build.notebook(cells, outputs))
    printed, picture = made["cells"][1]["outputs"]
    assert printed["text"] == ["7\n"] and picture["data"]["image/png"].startswith("iVBOR")
    assert "outputs" not in made["cells"][2] and made["nbformat"] == 4


def test_an_unknown_notebook_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert build.main(["salienci"]) == 2
    assert "unknown notebook 'salienci': there are saliency," in capsys.readouterr().err
