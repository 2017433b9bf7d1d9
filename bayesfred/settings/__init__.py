"""The run file: one TOML file that says what a run fits, to what, and how.

`run` reads that of one frame, `joint` that of many. `sections` makes the sections of a run file
from the classes that they describe; `frame` and `simulation` have the others. `example.toml` beside
these modules is a complete run file. `bayesfred.build` makes the objects.
"""

from bayesfred.settings.run import RunSettings, read_settings
from bayesfred.settings.sections import toml

__all__ = ["RunSettings", "read_settings", "toml"]
