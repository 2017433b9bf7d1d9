"""Make the paper's tables and figures.

    python -m examples.paper                   everything: README.md and pictures/ beside this file
    python -m examples.paper table2 figure6    print these and make their pictures
    python -m examples.paper --quick           print what takes no sampling, in half a minute
                                               (the tests compare it with README.md)

Everything takes five to ten minutes on two cores. Seeds are fixed, so that a run again gives the
same numbers up to rounding.
"""

import argparse
from importlib import import_module

from .common import HERE, Row, Section

MODULES = ("frames", "sampling", "figure5", "figure6", "table2", "table3")

HEAD = """# The paper's tables and figures

Made by `python -m examples.paper`; do not edit. The paper is Y. Sun & J. Zhou, *Field Distortion
Model Based on Fredholm Integral*. Every number that it prints stands beside ours; a number with ±
is a posterior mode and its standard deviation, or its section says what the error is. Two numbers
agree if they differ by less than three standard errors of their difference, both measurements
having the same error (the frames have different noise); without noise, as each row or section says.
"about" is rounding error, of which the size alone means something.
"""


def verdict(row: Row) -> str:
    return "" if row.agrees is None else "yes" if row.agrees else "no"


def markdown(section: Section, pictures: str) -> str:
    lines = (
        [f"## {section.title}", "", section.text, ""]
        if section.text
        else [f"## {section.title}", ""]
    )
    if section.wide:
        lines += [section.wide, ""]
    lines += ["| quantity | paper | here | agrees | remark |", "|---|---|---|---|---|"]
    lines += [
        f"| {r.quantity} | {r.printed} | {r.ours} | {verdict(r)} | {r.why} |" for r in section.rows
    ]
    lines += [f"\n![{section.title}]({pictures}{name})" for name in section.pictures]
    return "\n".join(lines) + "\n"


def summary(sections: list[Section]) -> str:
    """How many of the printed numbers agree, and which do not."""
    rows = [row for section in sections for row in section.rows if row.agrees is not None]
    agreed = sum(bool(row.agrees) for row in rows)
    return (
        f"{agreed} of {len(rows)} comparisons agree; those that do not: "
        + "; ".join(row.quantity for row in rows if not row.agrees)
        + ".\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m examples.paper", description="The paper's tables and figures."
    )
    parser.add_argument(
        "names", nargs="*", choices=[*MODULES, []], help="which of " + ", ".join(MODULES)
    )
    parser.add_argument(
        "--quick", action="store_true", help="leave out what needs sampling, and the pictures"
    )
    given = parser.parse_args()
    everything = not given.names and not given.quick
    folder = HERE / "pictures"
    folder.mkdir(exist_ok=True)
    sections = []
    for name in given.names or MODULES:
        sections.append(import_module(f"{__package__}.{name}").make(given.quick, folder))
        print(markdown(sections[-1], "pictures/"), flush=True)
    if everything:
        text = "\n".join(
            [HEAD, summary(sections), *(markdown(section, "pictures/") for section in sections)]
        )
        (HERE / "README.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
