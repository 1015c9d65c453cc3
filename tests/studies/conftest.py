"""Studies run in this process, with few repetitions."""

from __future__ import annotations

import nbformat
import pytest

from lib import paths
from lib.workbench import report


@pytest.fixture
def run_study(monkeypatch):
    """run_study(name, **parameters) -> (metrics by name, the notebook's variables)."""

    def run(name, **parameters):
        metrics = {}
        monkeypatch.setattr(report, "record", lambda metric, value, *_, **__: metrics.__setitem__(metric, float(value)))
        variables = {}
        for cell in nbformat.read(paths.NOTEBOOKS / "studies" / f"{name}.ipynb", as_version=4).cells:
            if cell.cell_type != "code":
                continue
            exec(compile(cell.source, cell.id, "exec"), variables)
            if "parameters" in cell.metadata.get("tags", []):
                assert set(parameters) <= set(variables), f"{name} has no such parameter"
                variables.update(parameters)
        return metrics, variables

    return run
