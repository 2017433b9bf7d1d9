"""Whole runs from a run file: build the posterior, fit, sample, judge, write the report.

Every command returns a record and prints nothing. What should be known while it works goes to
`say`, which is told one line at a time. `show.py` prints the records.
"""

from bayesfred.commands.calibrating import calibration, correct
from bayesfred.commands.fitting import demo, fit, report, simulate_frame
from bayesfred.commands.judging import compare, crosscheck, study, verify
from bayesfred.commands.planning import design
from bayesfred.commands.proposal import init

__all__ = [
    "calibration",
    "compare",
    "correct",
    "crosscheck",
    "demo",
    "design",
    "fit",
    "init",
    "report",
    "simulate_frame",
    "study",
    "verify",
]
