"""The paper's tables and figures made anew: `python -m examples.paper` makes all, `python -m examples.paper table2` one."""
