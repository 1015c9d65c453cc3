"""The main job: `command` runs the notebooks and makes a report, `sweep` runs one notebook over a grid of parameters.

Notebooks call `report` to state their results and `results` to read recorded tables.
"""

import sys

# nbformat's validator would build this grammar of addresses, which takes 2 s in every process and no notebook needs.
sys.modules.setdefault("rfc3987_syntax", None)
