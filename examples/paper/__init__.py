"""The paper's tables and figures: `python -m examples.paper` makes all, `... table2` one."""
