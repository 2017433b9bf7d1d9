"""What all tests share: where real frames are, and no stale compiled code."""

import os
from pathlib import Path

import bayesfred

ROOT = Path(__file__).parents[1]
os.environ.setdefault("BAYESFRED_DATA", str(ROOT.parent / "shared" / "data"))

# numba notices a change in a function's own file only; the inference kernels contain the imaging ones.
package = Path(bayesfred.__file__).parent
inlined = (package / "imaging" / "_kernels.py").stat().st_mtime
for index in (package / "inference" / "__pycache__").glob("_kernels*.nbi"):
    if index.stat().st_mtime < inlined:
        index.unlink()
