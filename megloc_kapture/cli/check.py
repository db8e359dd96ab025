"""``megloc check``: is a pose file right? Finds what is wrong with it, and names it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from megloc_kapture.cli.common import Common
from megloc_kapture.cli.console import Console
from megloc_kapture.errors import DataError

# a wrong file is the user's to mend, as wrong data are
PROBLEMS_FOUND = 2
_RUNS = Path("runs")


@dataclass(frozen=True, kw_only=True)
class Check(Common):
    """Check a pose file, ours or foreign, against the rules of its challenge and the map."""

    dataset: tyro.conf.Positional[str]
    """Dataset whose rules hold: aachen, robotcar, 4seasons, inloc, kapture, synthetic or a twin."""
    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Pose file; for 4seasons also the folder of all of them."""
    data: Path | None = None
    """Imported dataset or workspace to compare with; runs/DATASET-* where there is just one."""
    json: bool = False
    """Print everything that was found as JSON."""

    def run(self) -> int:
        """Run it; returns 2 where there are problems."""
        from megloc_kapture.evaluation.check.reading import read_reference
        from megloc_kapture.evaluation.check.submission import check_submission
        from megloc_kapture.io.dataset_tables import PROTOCOL_FILE, SIDE_TABLES
        from megloc_kapture.pipeline.datasets import TWIN_PREFIX
        from megloc_kapture.pipeline.submission import check_dataset, check_known

        console = self.console()
        check_known(self.dataset)
        if not self.file.exists():
            raise DataError("no such file", path=self.file)
        data = self.data or self._workspace(console)
        reference = None if data is None else read_reference(data)
        if reference is not None and data is not None:
            tables = data / SIDE_TABLES
            known = (tables / PROTOCOL_FILE).is_file()
            check_dataset(self.dataset, reference.protocol, tables=tables if known else None)
        report = check_submission(
            self.file, dataset=self.dataset.removeprefix(TWIN_PREFIX), reference=reference
        )
        if self.json:
            console.result(json.dumps(report.to_json(), indent=2, ensure_ascii=False))
        else:
            for line in report.lines():
                console.result(line)
        return PROBLEMS_FOUND if report.has_problems else 0

    def _workspace(self, console: Console) -> Path | None:
        from megloc_kapture.pipeline.datasets import dataset_names

        # runs/synthetic-aachen-classic is no run of dataset synthetic
        longer = tuple(f"{n}-" for n in dataset_names() if n.startswith(f"{self.dataset}-"))
        found = [
            path
            for path in sorted(_RUNS.glob(f"{self.dataset}-*"))
            if (path / "mapping" / "sensors" / "sensors.txt").is_file()
            and not path.name.startswith(longer or "/")
        ]
        if len(found) == 1:
            console.say(f"compared with {found[0]}")
            return found[0]
        if found:
            names = ", ".join(map(str, found))
            console.say(f"compared with none of {names}: choose with --data")
        return None
