"""The command line: options in, results printed, exit codes out. The work is in `commands`.

Exit codes: 0 done and trustworthy; 2 bad input (one line, no traceback); 3 finished, but not
sampled well, or the model does not fit the counts, or a check does not hold; 130 interrupted or
terminated with everything saved.
"""

from enum import StrEnum
from importlib import metadata, resources
from pathlib import Path
from typing import Annotated

import typer

import bayesfred as bf
from bayesfred.errors import InputError
from bayesfred.terminal import run, say_to

app = typer.Typer(
    help="Posterior of an imaging system's field distortion, from a frame of photon counts.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

Run = Annotated[Path, typer.Argument(metavar="RUN.toml", help="The run file.", show_default=False)]
ChainFile = Annotated[
    Path, typer.Argument(metavar="CHAIN.h5", help="A chain file.", show_default=False)
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
Out = Annotated[
    Path | None,
    typer.Option("--out", metavar="PAGE.html", help="The page.", show_default="beside the chain"),
]
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object; everything else to standard error.")
]
MapOnly = Annotated[
    bool,
    typer.Option("--map-only", help="Do not sample: maximum, and errors from the information."),
]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="tls://HOST:PORT", help="A Dask cluster, see examples/many_workers.md."),
]
Resume = Annotated[bool, typer.Option("--resume", help="Resume the run in the output file.")]


def _example() -> str:
    """The example run file, marked paragraph by paragraph so that the help keeps its lines."""
    example = resources.files("bayesfred") / "settings" / "example.toml"
    text = example.read_text(encoding="utf-8")
    return "\n\n".join("\b\n" + paragraph for paragraph in text.strip().split("\n\n"))


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"bayesfred {metadata.version('bayesfred')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Show the version and exit.", callback=_print_version, is_eager=True
        ),
    ] = False,
) -> None:
    """Take the options that no command needs."""


@app.command()
def demo(
    folder: Annotated[Path, typer.Option(help="Where demo.h5, demo.html and demo.png go.")] = Path(
        "chains"
    ),
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the simulated frame and of the sampler.")
    ] = 1,
    map_only: MapOnly = False,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Simulate the paper's frame, fit it and report: 81 sources, 12 terms, Poisson counts."""
    run(
        lambda: bf.show.show_run(
            bf.commands.demo(
                folder, seed=seed, map_only=map_only, overwrite=overwrite, say=say_to(as_json)
            ),
            as_json=as_json,
        )
    )


@app.command()
def simulate(run_file: Run, overwrite: Overwrite = False) -> None:
    """Simulate the frame that [simulation] describes, and its source grid, if it has one."""
    run(
        lambda: bf.show.show_simulated(bf.commands.simulate_frame(run_file, overwrite=overwrite)),
        run_file,
    )


@app.command()
def init(
    frame: Annotated[Path, typer.Argument(metavar="FRAME", help="A frame.", show_default=False)],
    second: Annotated[
        Path | None,
        typer.Argument(metavar="SECOND", help="Another of the same scene.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="RUN.toml", help="The run file.", show_default="after the frame"
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Propose a run file: gain, pedestal and read noise from the frame's own noise."""
    run(
        lambda: bf.show.show_proposal(bf.commands.init(frame, second, out=out, overwrite=overwrite))
    )


@app.command(epilog="A complete run file:\n\n" + _example())
def fit(
    run_file: Run,
    map_only: MapOnly = False,
    resume: Resume = False,
    overwrite: Overwrite = False,
    *,
    scheduler: Scheduler = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Processes that evaluate several frames.", show_default="this one"
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Find the posterior of a frame's distortion: maximum, draws, diagnostics, report.

    Of several frames, in [[frames]], it is the posterior of the lens that they share.
    """
    run(
        lambda: bf.show.show_run(
            bf.commands.fit(
                run_file,
                map_only=map_only,
                resume=resume,
                overwrite=overwrite,
                scheduler=scheduler,
                workers=workers,
                say=say_to(as_json),
            ),
            as_json=as_json,
        ),
        run_file,
    )


class Kind(StrEnum):
    """Kinds of studies."""

    noise = "noise"
    sbc = "sbc"


@app.command()
def study(
    run_file: Run,
    kind: Annotated[
        Kind | None,
        typer.Option(
            help="Noise levels, or simulation-based calibration.", show_default="the run file's"
        ),
    ] = None,
    scheduler: Scheduler = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes of the pool.", show_default="one a core")
    ] = None,
    resume: Resume = False,
    overwrite: Overwrite = False,
) -> None:
    """Fit many simulated frames: how well can a distortion be known, and do error bars hold."""
    run(
        lambda: bf.show.show_study(
            bf.commands.study(
                run_file,
                kind=kind and kind.value,
                scheduler=scheduler,
                workers=workers,
                resume=resume,
                overwrite=overwrite,
                say=print,
            )
        ),
        run_file,
    )


@app.command()
def design(run_file: Run, overwrite: Overwrite = False) -> None:
    """Before the exposure: the errors that a frame would have, the best sources and pointings."""
    run(lambda: bf.show.show_design(bf.commands.design(run_file, overwrite=overwrite)), run_file)


@app.command()
def report(
    chain_file: ChainFile,
    target_ess: Annotated[
        float | None,
        typer.Option(
            min=1, help="Effective draws to ask of every parameter.", show_default="the run's"
        ),
    ] = None,
    corner: Annotated[
        str,
        typer.Option(
            metavar="NAME,NAME,...",
            help="Parameters to show in pairs.",
            show_default="at most 12, of the most correlated pairs",
        ),
    ] = "",
    out: Out = None,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Judge a chain file again and write its report, .html and .png."""
    names = [name.strip() for name in corner.split(",") if name.strip()]
    run(
        lambda: bf.show.show_run(
            bf.commands.report(
                chain_file,
                target_ess=target_ess,
                corner=names,
                out=out,
                overwrite=overwrite,
                say=say_to(as_json),
            ),
            as_json=as_json,
        ),
        chain_file,
    )


@app.command()
def compare(
    chain_files: Annotated[
        list[Path],
        typer.Argument(metavar="A.h5 B.h5 ...", help="Chains of one frame.", show_default=False),
    ],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", metavar="PAGE.html", help="Show the runs side by side.", show_default="no page"
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Rank models of one frame by how well they predict sources that are left out."""
    run(
        lambda: bf.show.show_comparison(
            bf.commands.compare(chain_files, out=out, overwrite=overwrite, say=print)
        )
    )


@app.command()
def crosscheck(
    run_file: Run,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Fit two halves of the sources apart: are the errors too small, right or too large."""
    run(
        lambda: bf.show.show_cross_check(
            bf.commands.crosscheck(run_file, say=None if as_json else print), as_json=as_json
        ),
        run_file,
    )


@app.command()
def calibration(
    chain_file: ChainFile,
    *,
    sip: Annotated[
        int | None, typer.Option(metavar="DEGREE", help="A FITS header, TAN-SIP of degree 2 to 9.")
    ] = None,
    tpv: Annotated[
        int | None, typer.Option(metavar="DEGREE", help="A FITS header, TPV of degree 1 to 7.")
    ] = None,
    gwcs: Annotated[
        int | None, typer.Option(metavar="DEGREE", help="A gwcs in ASDF, of degree 2 to 9.")
    ] = None,
    opencv: Annotated[bool, typer.Option("--opencv", help="OpenCV's camera, JSON.")] = False,
    focal_length: Annotated[
        float | None,
        typer.Option(help="For OpenCV, recorded pixels.", show_default="from the sky"),
    ] = None,
    frame: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Of several frames, this one.", show_default="the only"),
    ] = None,
    regions: Annotated[
        bool, typer.Option("--regions", help="Residuals of the sources, for DS9.")
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The file.", show_default="beside the chain"),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Hand a calibration over: positions with errors, maps and a picture, or another tool's format.

    Exit code 3 says that the fit cannot be trusted; the files are written nevertheless.
    """
    degrees = {"sip": sip, "tpv": tpv, "gwcs": gwcs}
    forms = [form for form, degree in degrees.items() if degree is not None]
    forms += ["opencv"] * opencv + ["regions"] * regions

    def work() -> bool:
        if len(forms) > 1:
            raise InputError(f"got --{' and --'.join(forms)}, expected one format a call")
        form = forms[0] if forms else None
        return bf.show.show_calibration(
            bf.commands.calibration(
                chain_file,
                form=form,
                degree=degrees.get(form or "") or 3,
                focal_length=focal_length,
                frame=frame,
                out=out,
                overwrite=overwrite,
                say=print,
            )
        )

    run(work, chain_file)


@app.command()
def correct(
    frame: Annotated[Path, typer.Argument(metavar="FRAME", help="A frame.", show_default=False)],
    calibration_file: Annotated[
        Path, typer.Argument(metavar="CALIBRATION.h5", help="A calibration.", show_default=False)
    ],
    *,
    out: Annotated[
        Path,
        typer.Option("--out", metavar="FILE.fits", help="The frame to write.", show_default=False),
    ],
    like: Annotated[
        Path | None,
        typer.Option(
            "--like",
            metavar="OTHER.fits",
            help="Use the pixels of this image.",
            show_default="the object plane",
        ),
    ] = None,
    gain: Annotated[float | None, typer.Option(help="e-/adu", show_default="the header's")] = None,
    pedestal: Annotated[float | None, typer.Option(help="Stored units.", show_default="0")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Resample a frame to undistorted coordinates: counts, errors, mask, WCS."""
    run(
        lambda: bf.show.show_corrected(
            bf.commands.correct(
                frame,
                calibration_file,
                out=out,
                like=like,
                gain=gain,
                pedestal=pedestal,
                overwrite=overwrite,
            )
        )
    )


@app.command()
def verify(
    chain_file: ChainFile,
    every_draw: Annotated[
        bool, typer.Option("--all", help="Every draw and step, not 1,000 draws and 10 steps.")
    ] = False,
) -> None:
    """Compute again what a chain file holds: hashes, log-probabilities, maximum, first steps."""
    run(
        lambda: bf.show.show_verification(bf.commands.verify(chain_file, every_draw=every_draw)),
        chain_file,
    )
