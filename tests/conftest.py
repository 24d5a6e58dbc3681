"""What holds for all tests."""

from __future__ import annotations

import os

# Before torch is imported: its threads wait for each other in a loop, and beside other work on the same cores small networks
# learn two to three times as fast on one.
os.environ.setdefault("OMP_NUM_THREADS", "1")

# Before consoles are made: rich would keep to the width of the terminal in which the tests happen to run, or which pytest-xdist
# makes up, whatever a test sets.
for _variable in ("COLUMNS", "LINES"):
    os.environ.pop(_variable, None)
