"""The file that a benchmark leaves: its rows and what is known of the machine, as CSV or JSON."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from arcade_torch.tools.files import write_csv, write_json


def check_table_file(path: Path | None) -> None:
    """Refuse a name before anything is measured.

    Args:
        path: of the file; None for none.

    Raises:
        ValueError: it ends neither in .csv nor in .json.
    """
    if path is not None and path.suffix not in (".csv", ".json"):
        raise ValueError(f"--out must end in .csv or .json, got {path}")


def save_table(path: Path | None, rows: Sequence[Mapping[str, Any]], about: Mapping[str, Any]) -> None:
    """Write the rows atomically and print where; CSV repeats in every row what is known of the machine.

    Args:
        path: of the file; None for none.
        rows: of the table, all with the same keys.
        about: name -> value, of the machine and the setting.
    """
    if path is None:
        return
    if path.suffix == ".json":
        write_json(path, {"machine": about, "rows": rows})
    else:
        write_csv(path, [{**row, **about} for row in rows], [*rows[0], *about])
    print(path)
