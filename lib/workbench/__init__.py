"""The main job: `command` runs the notebooks and makes a report, `sweep` runs one notebook over a grid of parameters.

Notebooks call `report` to state what they find and `results` to read what was recorded.
"""

import sys

# nbformat's validator would build this grammar of addresses, for 2 s in every process; no notebook needs it.
sys.modules.setdefault("rfc3987_syntax", None)
