"""Figures look the same whatever the user has set in matplotlib, and leave what the user has set
alone.
"""

import os
import subprocess
import sys
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import pytest

from arcade_torch.tools.figures import PaperOptions
from arcade_torch.tools.figures.catalogue import make_figure
from arcade_torch.tools.figures.style import drawing

USERS = {
    "text.usetex": True,
    "font.size": 31.0,
    "savefig.bbox": "tight",
    "savefig.format": "jpg",
    "savefig.dpi": 20,
    "figure.autolayout": True,
    "figure.dpi": 40,
    "axes.facecolor": "red",
    "axes.titlesize": "xx-large",
    "axes.formatter.use_mathtext": True,
    "text.parse_math": True,
    "path.sketch": (1.0, 100.0, 2.0),
    "svg.fonttype": "path",
    "interactive": True,
    "toolbar": "None",
}


def drawn(folder: Path, **settings: object) -> bytes:
    """The picture of a figure, under some settings of the user's."""
    with mpl.rc_context():
        mpl.rcParams.update(settings)
        made = make_figure("human", PaperOptions(out=folder / "human.png", paper=True))
    return made.files[0].read_bytes()


def test_a_figure_is_the_same_under_any_settings_of_the_user(tmp_path: Path) -> None:
    plain = drawn(tmp_path)
    assert drawn(tmp_path, **USERS) == plain
    with plt.style.context(["dark_background", "ggplot"]):
        assert drawn(tmp_path) == plain
    with plt.xkcd():
        assert drawn(tmp_path) == plain


def test_settings_figures_and_environment_of_the_user_stay(tmp_path: Path) -> None:
    with mpl.rc_context():
        mpl.rcParams.update(USERS)
        mine = plt.figure()
        before = dict(mpl.rcParams.copy())
        environment, figures = dict(os.environ), plt.get_fignums()
        drawn(tmp_path)
        with pytest.raises(ZeroDivisionError), drawing("print"):
            1 / 0  # noqa: B018
        assert dict(mpl.rcParams.copy()) == before
        assert (
            plt.get_fignums() == figures and plt.gcf() is mine and dict(os.environ) == environment
        )
        plt.close(mine)


def test_our_figures_are_none_of_pyplot() -> None:
    before = plt.get_fignums()
    with drawing("light") as ours:
        figure, axes = ours.subplots(1, 2, figsize=(3, 2), sharey=True, width_ratios=[1, 2])
    assert isinstance(axes, np.ndarray) and tuple(figure.get_size_inches()) == (3, 2)
    assert plt.get_fignums() == before


INLINE = "module://matplotlib_inline.backend_inline"


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("MPLBACKEND", INLINE),
        ("MPLBACKEND", "no such backend"),
        ("MPLBACKEND", "TkAgg"),
        ("MATPLOTLIBRC", "text.usetex: True\nfont.size: 40\nbackend: nonsense\n"),
        ("MATPLOTLIBRC", "font.family: Schr\udcf6dinger\n"),
        ("MATPLOTLIBRC", "no: such: thing\nfigure.figsize: huge\n"),
    ],
)
def test_a_command_draws_whatever_the_environment_says(
    variable: str, value: str, tmp_path: Path
) -> None:
    if variable == "MATPLOTLIBRC":
        file = tmp_path / "matplotlibrc"
        file.write_bytes(value.encode(errors="surrogateescape"))
        value = str(file)
    words = [
        sys.executable,
        "-m",
        "arcade_torch.tools",
        "figure",
        "human",
        "--out",
        str(tmp_path / "human.png"),
    ]
    environment = {**os.environ, variable: value}
    done = subprocess.run(
        words, env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert (tmp_path / "human.png").read_bytes() == drawn(tmp_path / "here")


def test_the_environment_is_as_it_was_after_an_import_that_failed_at_first() -> None:
    script = """
import os, sys
os.environ["MPLBACKEND"] = "no such backend"
from arcade_torch.tools.figures.style import drawing
before = dict(os.environ)
with drawing("light") as ours:
    ours.subplots()[0].savefig(sys.argv[1], format="png")
assert dict(os.environ) == before
assert "matplotlib.pyplot" not in sys.modules
"""
    done = subprocess.run(
        [sys.executable, "-c", script, os.devnull],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
