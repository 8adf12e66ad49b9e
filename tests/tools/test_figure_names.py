"""Names in figures are text: never mathematics, never markup, and never missing from a legend."""

import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from io import BytesIO
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.text import Text

from arcade_torch.agents.runs.files import read_csv
from arcade_torch.tools import cli, saliency_figure
from arcade_torch.tools.comparable import find_runs
from arcade_torch.tools.figures import fonts, logs
from arcade_torch.tools.figures.catalogue import FIGURES
from arcade_torch.tools.figures.fonts import save_figure
from arcade_torch.tools.figures.style import drawing, legend_above, new_figure, svg
from arcade_torch.tools.measures.gap_bias import ScoreOptions
from arcade_torch.tools.measures.gap_bias.figure import gap_bias, returns, score_panels
from arcade_torch.tools.measures.gap_bias.measure import gap_and_bias
from arcade_torch.tools.names import printable
from arcade_torch.tools.scores import read_scores
from tests.tools.test_runs import write

HOSTILE = [
    r"$\frac{$", "$$", "$x^{$", r"\frac{1}{2}", "$" + "{" * 3000 + "$", "a_b^c%d", "_hidden", "__", "50 % #1 & ~", "\\",
    "<b>&amp;</b>", "\u202e\u200b", "a\x07\x1b[2J", "é", " ", "=1+1", "x" * 200,
]  # fmt: skip


@pytest.mark.parametrize("figure", ["returns", "gap-bias"])
def test_any_name_in_a_table_of_scores_is_drawn(
    figure: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = ["agent,game,observability,seed,score"]
    for agent in (*HOSTILE, "mlp"):
        for game in ("TetrisEasy", "$x^{$", "$y_{\x07$"):
            cells = ",".join('"' + cell.replace('"', '""') + '"' for cell in (agent, game))
            lines += [
                f"{cells},{twin},{seed},0.{seed + 2}"
                for twin in ("full", "partial")
                for seed in (0, 1)
            ]
    (tmp_path / "scores.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    words = [
        "figure",
        figure,
        "--runs",
        str(tmp_path / "scores.csv"),
        "--out",
        str(tmp_path / "f.pdf"),
    ]
    words = words if figure == "gap-bias" else [*words[:-1], str(tmp_path)]
    assert cli.main(words) == 0, capsys.readouterr().err


def test_any_name_in_a_run_is_drawn_as_it_is_written(tmp_path: Path) -> None:
    names = [*HOSTILE, "\ud800", "mlp"]
    for place, memory in enumerate(names):
        write(tmp_path / "runs" / f"{place:02}", memory, "full", 0, 0.5, env="$x^{$\x07Easy")
    options = logs.CurveOptions((tmp_path / "runs",), tmp_path / "curves.png")
    with drawing("light"):
        (picture,) = logs.curves(options, None).pictures
        shown = [text.get_text().lstrip("\u200b") for text in picture.figure.legends[0].get_texts()]
        text = svg(picture.figure, "\ud800\x07")
    assert shown == [printable(name) for name in names]
    assert picture.figure.axes[0].get_title() == r"$x^{$\x07Easy, MDP"
    for prefix in ("href", "xlink:href"):
        text = text.replace(f" {prefix}=", " link=")
    words = " ".join(ElementTree.fromstring(text).itertext())
    assert all(re.sub(r"\s+", " ", printable(name)).strip() in words for name in names)


def test_every_name_of_many_stands_inside_the_picture(tmp_path: Path) -> None:
    """Eight columns of long names were wider than the picture: half of fifty agents were cut off."""
    for place in range(30):
        name = f"m{place:02}" + "_with_a_long_name_of_its_own" * (place % 10 == 0)
        for twin in ("full", "partial"):
            write(tmp_path / f"{place:02}-{twin}", name, twin, 0, 0.5)
    with drawing("light"):
        (picture,) = logs.curves(logs.CurveOptions((tmp_path,)), None).pictures
        figure = picture.figure
        figure.draw_without_rendering()
        for text in figure.legends[0].get_texts():
            box = text.get_window_extent()
            assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, text.get_text()
            assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, text.get_text()
        assert all(axis.get_window_extent().height > 100 for axis in figure.axes)


def test_a_line_break_in_a_name_is_written_out(tmp_path: Path) -> None:
    write(tmp_path / "0", "a\nb", "full", 0, 0.5)
    write(tmp_path / "1", "mlp", "full", 0, 0.5, network_options={"note": "x\r\n\x1b"})
    write(tmp_path / "2", "mlp", "full", 0, 0.5)
    assert set(find_runs([tmp_path]).names.values()) == {r"a\nb", "mlp", r"mlp note=x\r\n\x1b"}


def test_options_and_settings_with_dollars_are_drawn(tmp_path: Path) -> None:
    write(tmp_path / "0", "lru", "full", 0, 0.5, network_options={r"$\frac{": r"$\sqrt{"})
    for figure in ("curves", "hyperparameters"):
        assert cli.main(["figure", figure, str(tmp_path / "0"), "--out", str(tmp_path / "f")]) == 0


def test_names_of_games_in_a_file_of_rates_are_drawn(tmp_path: Path) -> None:
    lines = ["game,measure,obs_size,num_envs,frames_per_s_with_check,jax_device"]
    for game in (r"$\frac{", "_x", "a\x1bb"):
        lines += [
            f"{game},step+draw,128,{count},{1000 * count},$\\frac{{ cpu" for count in (1, 16, 256)
        ]
    (tmp_path / "rates.csv").write_text("\n".join(lines) + "\n")
    assert (
        cli.main(
            ["figure", "throughput", str(tmp_path / "rates.csv"), "--out", str(tmp_path / "f")]
        )
        == 0
    )
    assert {row["series"] for row in read_csv(tmp_path / "f" / "throughput.csv")} >= {
        r"$\frac{",
        "_x",
        r"a\x1bb",
    }


def test_ticks_of_rates_are_powers_of_ten(tmp_path: Path) -> None:
    lines = ["game,measure,obs_size,num_envs,frames_per_s_with_check"]
    lines += [
        f"A,step+draw,128,{count},{rate}"
        for count, rate in ((1, 900), (16, 12_000), (256, 1_200_000))
    ]
    (tmp_path / "rates.csv").write_text("\n".join(lines) + "\n")
    with drawing("light"):
        (picture,) = logs.throughput(logs.Options((tmp_path / "rates.csv",)), None).pictures
        picture.figure.draw_without_rendering()
        shown = [text.get_text() for text in picture.figure.axes[0].get_yticklabels()]
    assert {"10³", "10⁴", "10⁵", "10⁶"} <= set(shown)


def test_titles_of_saliency_are_text_and_its_times_are_mathematics() -> None:
    frames, maps = np.zeros((2, 4, 4, 3), np.uint8), np.ones((2, 4, 4), np.float32)
    for given in (new_figure(), None):  # outside of our style
        figure = saliency_figure([(r"$\frac{ 50 %", frames, maps)], figure=given)
        figure.canvas.draw()
        (part,) = figure.subfigs
        assert (
            part._suptitle.get_text().startswith(r"$\frac{ 50 %")
            and not part._suptitle.get_parse_math()
        )
        assert all(axis.title.get_parse_math() for axis in part.axes)


def test_every_maker_of_figures_is_covered_here_or_has_no_names() -> None:
    drawn_here = {"returns", "gap-bias", "curves", "hyperparameters", "throughput", "saliency"}
    others: Any = {
        "human",
        "size-sweep",
        "recall-density",
        "counterfactual",
        "beliefs",
        "contamination",
    }  # fixed names, or by the style alone
    assert set(FIGURES) == drawn_here | others


def scores_of(folder: Path, agents: Sequence[str]) -> Path:
    """A table of scores of some agents, near each other, and of one without memory."""
    lines = ["agent,game,observability,seed,score"]
    for place, agent in enumerate(("mlp", *agents)):
        for game, twin in product(("TetrisEasy", "SignpostEasy"), ("full", "partial")):
            value = 0.3 + 0.01 * (7 * place % 11) + 0.02 * (place % 5) * (twin == "full")
            lines.append(f"{agent},{game},{twin},0,{value}")
    file = folder / "scores.csv"
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return file


def overlapping(boxes: Sequence[Any]) -> int:
    """How many pairs of boxes lie over each other."""
    return sum(one.overlaps(other) for one, other in combinations(boxes, 2))


@pytest.mark.parametrize("count", [11, 49])
def test_many_agents_are_numbered_in_gap_bias_and_named_beside_it(
    count: int, tmp_path: Path
) -> None:
    """Fifty names were drawn over each other and beyond the picture."""
    agents = [f"pqn-memory{place:02} 2x128" for place in range(count)]
    options = ScoreOptions(runs=(scores_of(tmp_path, agents),), draws=10)
    with drawing("light"):
        (picture,) = gap_bias(options, None).pictures
        picture.figure.draw_without_rendering()
        axis = picture.figure.axes[0]
        assert [text.get_text() for text in axis.texts] == [str(n) for n in range(1, count + 2)]
        boxes = [text.get_window_extent() for text in axis.texts]
        assert overlapping(boxes) <= count // 10
        named = axis.get_legend().get_texts()
        assert [text.get_text() for text in named][1:] == [
            f"{number}  {agent}" for number, agent in enumerate(agents, 2)
        ]
        right = picture.figure.bbox.x1
        assert all(text.get_window_extent().x1 <= right for text in named)
    looks = {(bar.lines[0].get_marker(), bar.lines[0].get_color()) for bar in axis.containers}
    assert len(looks) == count + 1


def test_names_of_agents_with_equal_scores_can_be_read(tmp_path: Path) -> None:
    """Before: where all agents solve a task their names were written over each other."""
    agents = ["lru 1x128", "gru 1x128", "lru 2x512"]
    lines = ["agent,game,observability,seed,score"]
    for agent, twin, seed in product(("mlp", *agents), ("full", "partial"), (0, 1)):
        lines.append(f"{agent},SignpostEasy,{twin},{seed},{0.7 + 0.1 * seed}")
    (tmp_path / "scores.csv").write_text("\n".join(lines) + "\n")
    with drawing("light"):
        options = ScoreOptions(runs=(tmp_path / "scores.csv",), draws=10)
        (picture,) = gap_bias(options, None).pictures
        picture.figure.draw_without_rendering()
        (axis,) = picture.figure.axes
        assert {text.get_text() for text in axis.texts} == {"mlp", *agents}
        assert not overlapping([text.get_window_extent() for text in axis.texts])


@pytest.mark.parametrize("most", [1, 6])
def test_a_legend_stands_beside_the_title(most: int) -> None:
    """Before: with six agents it was written over a title of a long name."""
    with drawing("light") as plt:
        figure, axis = plt.subplots(figsize=(9.5, 7.6), layout="constrained")
        for agent in (f"pqn-memory{place} 1x128" for place in range(6)):
            axis.plot([0, 1], [0, 1], label=agent)
        handles, _ = axis.get_legend_handles_labels()
        legend_above(figure, handles, most, "outside upper right", "NoisyCartPoleMedium-v0, POMDP")
        figure.draw_without_rendering()
        (legend,) = figure.legends
        title = figure._suptitle.get_window_extent()
        assert title.x1 < legend.get_window_extent().x0
        assert legend.get_window_extent().y0 > axis.get_window_extent().y1


def test_bars_and_legends_of_many_agents_stand_inside_the_picture(tmp_path: Path) -> None:
    agents = [f"pqn-memory{place:02} 2x128" for place in range(30)]
    options = ScoreOptions(runs=(scores_of(tmp_path, agents),), draws=10)
    with drawing("light"):
        bars, without = returns(options, None).pictures
        for figure in (bars.figure, without.figure):
            figure.draw_without_rendering()
        for axis in bars.figure.axes:
            names = axis.get_xticklabels()
            step = names[1].get_window_extent().x1 - names[0].get_window_extent().x1
            assert step > names[0].get_fontsize()
        (legend,) = without.figure.legends
        for text in legend.get_texts():
            box = text.get_window_extent()
            assert box.x0 >= 0 and box.x1 <= without.figure.bbox.x1


def test_letters_of_other_fonts_are_drawn_and_those_of_none_are_told_in_a_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Chinese names and emoji were boxes, each with a warning of matplotlib. U+24B6 is in STIX,
    which comes with matplotlib; no font has U+E0F0 of the private area.
    """
    words = ["figure", "gap-bias", "--runs", str(scores_of(tmp_path, ["\u24b6", "\ue0f0"]))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cli.main([*words, "--out", str(tmp_path / "f.png")]) == 0
    out, err = capfd.readouterr()
    assert "drawn as boxes, no installed font has them: \ue0f0; " in out
    assert "Glyph" not in out + err
    with drawing("light"):
        figure = new_figure()
        text = figure.text(0.5, 0.5, "a\u24b6")
        assert save_figure(figure, BytesIO(), format="png") == ""
    assert "STIXGeneral" in text.get_fontfamily()


def test_a_picture_that_is_drawn_again_leaves_nothing_of_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = iter([b"with boxes, and longer", b"with letters"])

    def draw(figure: Any, file: BytesIO, options: Any) -> str:
        file.write(next(drawn))
        return "\u24b6"

    monkeypatch.setattr(fonts, "_save", draw)
    file = BytesIO()
    save_figure(new_figure(), file)
    assert file.getvalue() == b"with letters"


@pytest.mark.parametrize("count", [1, 6, 20])
@pytest.mark.parametrize("name", ["a_memory_whose_name_has_all_forty_letter", "x" * 60])
def test_bars_of_a_report_have_room_beside_long_names(
    count: int, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before: a name of 40 letters left a strip of the panel, and its label was cut."""
    agents = [f"{place}{name}"[: len(name)] for place in range(count)]
    scores = read_scores([scores_of(tmp_path, agents)], "eval_final")
    monkeypatch.setattr("arcade_torch.tools.figures.style.svg", lambda figure, _: figure)
    with drawing("light"):
        for figure in score_panels(gap_and_bias(scores, draws=10)):
            figure.draw_without_rendering()
            (axis,) = figure.axes
            ticks = [*axis.get_xticklabels(), *axis.get_yticklabels()]
            names = [tick for tick in ticks if not tick.get_text()[-1].isdigit()]
            assert len(names) == count + 1
            around = (axis.title, axis.xaxis.label, axis.yaxis.label)
            for text in (*names, *filter(Text.get_text, around)):
                box = text.get_window_extent()
                assert box.x0 >= 0 and box.x1 <= figure.bbox.x1, text.get_text()
                assert box.y0 >= 0 and box.y1 <= figure.bbox.y1, text.get_text()
            room = axis.get_window_extent()
            assert room.width > figure.bbox.width / 3 and room.height > figure.bbox.height / 3
            assert not overlapping([text.get_window_extent() for text in names])


def test_a_bar_of_zero_is_seen(tmp_path: Path) -> None:
    """Before: agents that earn nothing left an empty panel."""
    options = ScoreOptions(runs=(scores_of(tmp_path, ["lru"]),), draws=10)
    with drawing("light"):
        for axis in returns(options, None).pictures[0].figure.axes:
            assert all(bar.get_edgecolor() == bar.get_facecolor() for bar in axis.patches)
