"""What holds for all tests."""

from __future__ import annotations

import os

# Before torch is imported: its threads wait for each other in a loop, and beside other work on the same cores small networks
# learn two to three times as fast on one.
os.environ.setdefault("OMP_NUM_THREADS", "1")
