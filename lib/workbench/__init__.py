"""The main job: executes the notebooks in order and makes the report of the run.

``run`` (in `command`) works through notebooks into ``runs/<date>-<profile>/``: executed notebooks, one page each,
figures, metrics.json, index.html.  ``sweep`` runs one notebook over a grid of parameters.  Notebooks call `report` to
state what they find and `results` to read what was recorded.
"""

import sys

# nbformat's validator would build this grammar of addresses, for 2 s in every process; no notebook needs it.
sys.modules.setdefault("rfc3987_syntax", None)
