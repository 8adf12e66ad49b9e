"""Engines by name."""

from arcade_torch.tools.studies.engines import Engine, Inline, Processes, available_cores
from arcade_torch.tools.studies.ray_engine import Ray

ENGINES = ("auto", "inline", "processes", "ray")


def make_engine(
    name: str,
    workers: int = 0,
    *,
    address: str = "",
    cpus_per_run: float = 1,
    gpus_per_run: float = 0,
    retries: int = 2,
) -> Engine:
    """An engine by its name.

    Args:
        name: ``inline``, ``processes``, ``ray``, or ``auto`` (processes where there is more than one core).
        workers: how many runs at once, 0 for one a core, or what a cluster can take.
        address: for ``ray``: of a cluster; empty for one of its own on this machine.
        cpus_per_run: for ``ray``: cores that a run keeps busy.
        gpus_per_run: for ``ray``: GPUs, or the part of one, that a run keeps busy.
        retries: for ``ray``: further attempts at a run whose process or machine was lost.

    Raises:
        ValueError: there is no such engine, or it has no such option.
        MissingPackage: ``ray`` is not installed.
    """
    if name == "ray":
        return Ray(workers, address, cpus_per_run, gpus_per_run, retries)
    given = {"address": bool(address), "cpus-per-run": cpus_per_run != 1, "gpus-per-run": gpus_per_run != 0}
    if wrong := [key for key, value in given.items() if value]:
        raise ValueError(f"--{wrong[0]} is for --engine ray, and the engine is {name}")
    if name == "auto":
        name = "processes" if len(available_cores()) > 1 else "inline"
    if name == "inline":
        return Inline()
    if name == "processes":
        return Processes(workers)
    raise ValueError(f"unknown engine {name!r}: allowed are {', '.join(ENGINES)}")
