"""How to repeat a study, as its report says it: shared settings, and those of each run."""

import json
from pathlib import Path

from arcade_torch.tools.reports.repeating import how_to_repeat
from tests.tools.fabricated import small_study, write_study


def test_a_run_has_the_settings_alone_that_not_all_runs_share(tmp_path: Path) -> None:
    study = small_study()
    folder = write_study(tmp_path, study)
    file = folder.run(study.runs()[0]).path / "config.json"
    record = json.loads(file.read_text())
    del record["config"]["obs_size"]  # as an older version left it out: it has its default
    record["config"]["pqn"]["gamma"] = 0.5
    file.write_text(json.dumps(record))
    said = how_to_repeat(folder, study, folder.rows(study))
    first, second, *_ = said["runs"]
    apart = {"memory", "observability", "seed", "pqn.gamma"}
    assert set(first["settings"]) == set(second["settings"]) == apart
    assert (first["settings"]["pqn.gamma"], second["settings"]["pqn.gamma"]) == (0.5, 0.99)
    assert not apart & set(said["shared"])
    assert said["shared"]["obs_size"] == 128 and said["shared"]["total_frames"] == 2048
    assert said["seconds"] == 8 * 95
