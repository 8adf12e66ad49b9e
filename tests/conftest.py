"""What all tests share: one thread a process, equal random numbers, markers that skip where they
cannot run.
"""

import gc
import importlib.util
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# Before torch or JAX is imported: two test processes share the machine.
for _variable in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# Many test files compile the same games; what one process compiled, the others read from disk.
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "jax")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

# Programs that tests start say their words as a user's do: into a log in blocks, unless they flush.
os.environ.pop("PYTHONUNBUFFERED", None)

# What tests import is no choice of the user who runs them.
os.environ["XDG_STATE_HOME"] = str(Path(__file__).resolve().parents[1] / ".pytest_cache" / "state")

# A shell has what it starts in the background ignore Ctrl-C, and so would all that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# So does nohup with SIGHUP. These tests still do; what they start does as behind a terminal.
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda number, frame: None)

# Compilation makes the first example slow, and a red test has to stay red when it is run again.
settings.register_profile(
    "arcade",
    deadline=None,
    derandomize=True,
    max_examples=20,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
)
settings.load_profile("arcade")


SLOW_CASES = Path(__file__).with_name("slow_cases.txt")


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--device cpu`` rehearses the tests marked `gpu` on the CPU, as far as they make sense
    there; so does the default where there is no card, lest they rot unseen.
    """
    parser.addoption(
        "--device",
        choices=("auto", "cuda", "cpu"),
        default="auto",
        help="device of the tests marked gpu; auto: cuda where torch has it, or else cpu",
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the cases of `slow_cases.txt`, and skip `gpu` and `ray` tests with a reason where the
    machine lacks what they need.
    """
    slow_cases = set(SLOW_CASES.read_text().splitlines())
    for item in items:
        if item.nodeid in slow_cases:
            item.add_marker(pytest.mark.slow)
    needing_gpu = [item for item in items if item.get_closest_marker("gpu")]
    if needing_gpu and _device_of_gpu_tests(config) == "cpu":
        needing_gpu = [
            item for item in needing_gpu if "device" not in getattr(item, "fixturenames", ())
        ]
    needing_ray = [item for item in items if item.get_closest_marker("ray")]
    if needing_gpu and not _has_cuda():
        for item in needing_gpu:
            item.add_marker(pytest.mark.skip(reason="needs a CUDA device"))
    if needing_ray and importlib.util.find_spec("ray") is None:
        for item in needing_ray:
            item.add_marker(pytest.mark.skip(reason="needs the ray extra: pip install '.[ray]'"))


def _has_cuda() -> bool:
    import torch

    return torch.cuda.is_available()


def _device_of_gpu_tests(config: pytest.Config) -> str:
    """``cuda`` or ``cpu``."""
    device = str(config.getoption("device"))
    if device != "auto":
        return device
    return "cuda" if _has_cuda() else "cpu"


@pytest.fixture
def device(request: pytest.FixtureRequest) -> str:
    """Where a test marked `gpu` runs: ``cuda``, or ``cpu`` in a rehearsal."""
    return _device_of_gpu_tests(request.config)


@pytest.fixture
def cuda(device: str) -> str:
    """``cuda``; skips the test in a rehearsal."""
    if device != "cuda":
        pytest.skip("says something on a CUDA device alone")
    return device


@pytest.fixture(autouse=True)
def _same_random_numbers() -> Iterator[None]:
    """Seed torch's global generator, so that a test does not depend on the ones that ran before
    it.
    """
    if "torch" in sys.modules:
        sys.modules["torch"].manual_seed(0)
    yield


@pytest.fixture(autouse=True)
def _memories_as_before() -> Iterator[None]:
    """Forget memory models that a test has registered: others compare the list with the
    documentation.
    """
    registry = sys.modules.get("arcade_torch.models.registry")
    before = None if registry is None else dict(registry._FACTORIES)
    yield
    if registry is not None and before is not None:
        registry._FACTORIES.clear()
        registry._FACTORIES.update(before)


@pytest.fixture(autouse=True)
def _import_path_as_before() -> Iterator[None]:
    """Forget folders of ``--import`` files: a module beside one hides a name from other tests."""
    before = list(sys.path)
    yield
    sys.path[:] = before


_GIGABYTE = 2**30
_most_bytes = 4 * _GIGABYTE


@pytest.fixture(autouse=True, scope="module")
def _memory_is_given_back() -> Iterator[None]:
    """Drop JAX's compiled programs after a file of tests when the process has become large.

    Two processes that keep every program of every game hold eight gigabytes each at the end, and
    one was seen to crash while it compiled one more. What a file of tests finds is taken out of
    the garbage collector's sight: a test that collects would otherwise look through all of it, for
    a second each time.
    """
    global _most_bytes
    gc.freeze()
    yield
    if "jax" in sys.modules and _resident_bytes() >= _most_bytes:
        sys.modules["jax"].clear_caches()
        gc.unfreeze()
        gc.collect()
        _most_bytes = max(_most_bytes, _resident_bytes() + 2 * _GIGABYTE)


def _resident_bytes() -> int:
    """Memory that this process holds; 0 where the system does not say."""
    try:
        pages = Path("/proc/self/statm").read_text().split()[1]
    except OSError:
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
