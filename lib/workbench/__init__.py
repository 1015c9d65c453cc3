"""The main job: executes the notebooks in order and makes the report of the run.

``run`` works through notebooks into ``runs/<date>-<profile>/`` (executed notebooks, one page each, figures,
metrics.json, index.html); ``sweep`` one notebook over a grid of parameters.
"""

from lib.workbench.command import main, run
from lib.workbench.execution import Failure, execute
from lib.workbench.parameters import UsageError, choose_notebooks, parse_parameters

__all__ = ["Failure", "UsageError", "choose_notebooks", "execute", "main", "parse_parameters", "run"]
