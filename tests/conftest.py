"""What all tests share: where real frames are, Ctrl-C that interrupts, and no stale compiled code."""

import os
import signal
from pathlib import Path

import bayesfred

ROOT = Path(__file__).parents[1]
os.environ.setdefault("BAYESFRED_DATA", str(ROOT.parent / "shared" / "data"))

# A shell that starts the tests in the background ignores SIGINT for them and for what they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# numba notices a change in a function's own file only; the inference kernels contain the imaging ones.
package = Path(bayesfred.__file__).parent
inlined = (package / "imaging" / "_kernels.py").stat().st_mtime
for index in (package / "inference" / "__pycache__").glob("_kernels*.nbi"):
    if index.stat().st_mtime < inlined:
        index.unlink(missing_ok=True)
