"""Standard streams, locales and settings of Python and JAX that a command may meet."""

import os
import pty
import select
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LIST = "-m arcade_torch.tools list envs"
FULL = Path("/dev/full")
slow = pytest.mark.slow
LIMIT_S = 120


def shell(line: str, folder: Path, **environment: str) -> "subprocess.CompletedProcess[bytes]":
    """Run a line of bash; ``python`` is this one."""
    line = line.replace("python ", f"'{sys.executable}' ", 1)
    return subprocess.run(
        ["bash", "-c", f"set -o pipefail; {line}"],
        capture_output=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        timeout=LIMIT_S,
        check=False,
    )


@pytest.mark.parametrize(
    ("line", "code", "out", "err"),
    [
        (f"python {LIST} >&-", 0, b"", b""),
        (f"python {LIST} 2>&-", 0, b"CartPoleEasy-v0", b""),
        pytest.param(f"python {LIST} <&- >&- 2>&-", 0, b"", b"", marks=slow),
        ("python -m arcade_torch.tools lost >&- 2>&-", 2, b"", b""),
        pytest.param("python -m arcade_torch.tools lost 2>&-", 2, b"", b"", marks=slow),
        (f"python {LIST} | head -1", 0, b"environments", b""),
        pytest.param("python -m arcade_torch.tools --help | true", 0, b"", b"", marks=slow),
        (
            "python -m arcade_torch.tools play CartPoleEasy --terminal <&- >&-",
            2,
            b"",
            b"standard input and standard",
        ),
        pytest.param(f"python -OO {LIST}", 0, b"CartPoleEasy-v0", b"", marks=slow),
        pytest.param(
            f"python -O -bOO -W ignore -X dev=0 {LIST}", 0, b"CartPoleEasy-v0", b"", marks=slow
        ),
        (
            "python -OO -m arcade_torch.tools bench train --help",
            0,
            b"usage: arcade-torch bench train",
            b"",
        ),
    ],
)
def test_a_command_works_with_strange_streams(
    line: str, code: int, out: bytes, err: bytes, tmp_path: Path
) -> None:
    result = shell(line, tmp_path)
    assert result.returncode == code, result
    assert out in result.stdout and err in result.stderr
    assert result.stderr.count(b"\n") <= (code != 0), result.stderr


@pytest.mark.skipif(not FULL.exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize(
    "words",
    [
        "--version",
        *(
            pytest.param(words, marks=slow)
            for words in ("--help", "list envs", "list --help", "study --preset demo --dry-run")
        ),
    ],
)
def test_a_full_disk_under_standard_output_is_one_line(words: str, tmp_path: Path) -> None:
    result = shell(f"python -m arcade_torch.tools {words} >/dev/full", tmp_path)
    assert result.returncode == 1
    said = result.stderr.decode().splitlines()
    assert said[-1].startswith(
        "arcade-torch: could not write to standard output: No space left on device"
    )
    assert "Traceback" not in result.stderr.decode()


def test_a_run_that_cannot_be_written_any_more_has_failed_and_is_no_bad_input(
    tmp_path: Path,
) -> None:
    """Array jobs try again by the exit code."""
    words = "train --preset smoke --total-frames 64 --out run"
    result = shell(f"ulimit -f 16; exec python -m arcade_torch.tools {words}", tmp_path)
    said = result.stderr.decode().splitlines()[-1]
    assert said.startswith("arcade-torch: could not write run/checkpoints/"), said
    assert "File too large; there is no checkpoint yet: raise ulimit -f" in said
    assert result.returncode == 1


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
LOCALES: dict[str, Mapping[str, str]] = {
    "c": {"LC_ALL": "C"},
    "ascii files too": ASCII,
    "ascii output": {"PYTHONIOENCODING": "ascii"},
    "latin": {"PYTHONIOENCODING": "latin-1"},
    "utf-8": {"PYTHONUTF8": "1"},
}


@pytest.mark.parametrize(
    "locale",
    [
        "ascii files too",
        *(pytest.param(name, marks=slow) for name in LOCALES if name != "ascii files too"),
    ],
)
@pytest.mark.parametrize("name", ["μνήμη".encode(), b"no text \xff\xfe"], ids=["greek", "bytes"])
def test_every_locale_meets_every_name(locale: str, name: bytes, tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    folder.mkdir()
    words = "list sheet CartPoleEasy --steps 0 --out out.png"
    result = shell(f"python -m arcade_torch.tools {words}", folder, **LOCALES[locale])
    assert result.returncode == 0, result.stderr.decode()
    assert (folder / "out.png").is_file() and not result.stderr
    missing = shell("python -m arcade_torch.tools report ./*/x", folder.parent, **LOCALES[locale])
    assert missing.returncode == 2 and missing.stderr.count(b"\n") == 1, missing.stderr.decode()


@pytest.mark.parametrize(
    "platform", ["cuda", *(pytest.param(name, marks=slow) for name in ("rocm", "tpu", "nonsense"))]
)
@pytest.mark.parametrize(
    "words",
    [
        "list sheet CartPoleEasy --steps 0",
        pytest.param("record CartPoleEasy --out x.gif", marks=slow),
    ],
)
def test_a_platform_that_jax_has_not_is_one_line(platform: str, words: str, tmp_path: Path) -> None:
    result = shell(f"python -m arcade_torch.tools {words}", tmp_path, JAX_PLATFORMS=platform)
    said = result.stderr.decode()
    assert result.returncode == 2 and said.count("\n") == 1, said
    assert said.startswith(
        f"arcade-torch: JAX_PLATFORMS is '{platform}', but JAX has no such device here"
    ), said
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "program",
    [
        'import arcade_torch; arcade_torch.make("CartPoleEasy")',
        "import arcade_torch, gymnasium; "
        'gymnasium.make_vec("arcade_torch/CartPoleEasy-v0", num_envs=2)',
    ],
)
def test_make_says_in_one_line_that_jax_has_no_such_platform(program: str, tmp_path: Path) -> None:
    result = shell(
        f"python -c '{program}'",
        tmp_path,
        JAX_PLATFORMS="cuda",
    )
    last = result.stderr.decode().splitlines()[-1]
    assert last.startswith(
        "ValueError: JAX_PLATFORMS is 'cuda', but JAX has no such device here"
    ), last


@pytest.mark.parametrize(
    ("environment", "reason"),
    [
        ({"JAX_ENABLE_X64": "abc"}, "invalid truth value 'abc' for environment 'JAX_ENABLE_X64'"),
        ({"JAX_DEFAULT_PRNG_IMPL": "abc"}, 'Invalid value "abc" for JAX flag jax_default_prng_imp'),
    ],
)
def test_a_setting_that_jax_refuses_is_one_line(
    environment: dict[str, str], reason: str, tmp_path: Path
) -> None:
    words = "list sheet CartPoleEasy --steps 0"
    result = shell(f"python -m arcade_torch.tools {words}", tmp_path, **environment)
    said = result.stderr.decode()
    assert result.returncode == 1 and said.count("\n") == 1, said
    assert said.startswith(f"arcade-torch: JAX refuses a setting of this shell: {reason}"), said


def test_play_names_the_stream_that_is_no_terminal(tmp_path: Path) -> None:
    master, slave = pty.openpty()
    words = [sys.executable, "-m", "arcade_torch.tools", "play", "CartPoleEasy", "--terminal"]
    pipe = subprocess.PIPE
    for stdin, stdout, names in (
        (slave, pipe, "standard output is"),
        (subprocess.DEVNULL, slave, "standard input is"),
    ):
        result = subprocess.run(
            words, stdin=stdin, stdout=stdout, stderr=pipe, cwd=ROOT, timeout=LIMIT_S, check=False
        )
        assert result.returncode == 2 and f"{names} redirected" in result.stderr.decode()
    environment = {**os.environ, "TERM": "dumb"}
    result = subprocess.run(
        words,
        stdin=slave,
        stdout=slave,
        stderr=pipe,
        cwd=ROOT,
        timeout=LIMIT_S,
        env=environment,
        check=False,
    )
    assert result.returncode == 2 and "TERM is dumb" in result.stderr.decode()
    assert not select.select([master], [], [], 0)[0]
    os.close(master)
    os.close(slave)
