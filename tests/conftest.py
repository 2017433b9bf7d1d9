"""What all tests share: where real frames are, Ctrl-C that interrupts, and no stale compiled code."""

import os
import signal
from contextlib import suppress
from pathlib import Path

import bayesfred

ROOT = Path(__file__).parents[1]
os.environ.setdefault("BAYESFRED_DATA", str(ROOT.parent / "shared" / "data"))

# A shell that starts the tests in the background ignores SIGINT for them and for what they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# numba notices a change in a function's own file only; what it compiled contains functions of the other kernels' modules.
package = Path(bayesfred.__file__).parent
newest = max(path.stat().st_mtime for path in package.glob("*/kernels/*.py"))
for index in package.glob("*/kernels/__pycache__/*.nbi"):
    with suppress(FileNotFoundError):  # other tests that begin now may have deleted it
        if index.stat().st_mtime < newest:
            index.unlink()
