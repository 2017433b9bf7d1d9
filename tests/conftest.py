"""What all tests share: where real frames are, and Ctrl-C that interrupts."""

import os
import signal
from pathlib import Path

ROOT = Path(__file__).parents[1]
os.environ.setdefault("BAYESFRED_DATA", str(ROOT.parent / "shared" / "data"))

# A shell that starts the tests in the background ignores SIGINT for them and for what they start.
signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP"):  # which `nohup` has ignored, there and in what they start
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
