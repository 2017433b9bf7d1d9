"""Sections of a run file for frames that are simulated: the truth, and what is studied with it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from bayesfred.settings.sections import Count, Float, NotNegative, Positive, Section, Seed

__all__ = ["DesignSettings", "GridSettings", "SimulationSettings", "StudySettings"]


class GridSettings(Section):
    """`[simulation.grid]`: a square grid of sources, written as the catalogue.

    Attributes
    ----------
    side : int
        Sources a side.
    spacing : float, pixel
        Distance between neighbours.
    flux : float, counts
        Flux of each source.
    """

    side: Annotated[int, Field(ge=1, le=1000)]
    spacing: Positive
    flux: Positive


class SimulationSettings(Section):
    """`[simulation]`: the truth of which `bayesfred simulate` makes a frame.

    Attributes
    ----------
    shape : (int, int), pixel
        Rows and columns (ny, nx) of the frame.
    theta : dict of float
        Distortion coefficients by parameter name; terms that are not named are zero.
    background : float, counts per pixel
        Expected background.
    seed : int
        Seed of the noise.
    grid : GridSettings, optional
        Sources to write as the catalogue; without it the catalogue is read.
    """

    shape: tuple[Count, Count]
    theta: dict[str, Float]
    background: NotNegative
    seed: Seed = 1
    grid: GridSettings | None = None


class StudySettings(Section):
    """`[study]`: what `bayesfred study` simulates and fits.

    Attributes
    ----------
    kind : {'noise', 'sbc'}
        Fits of the truth of [simulation] at several noise levels, or of truths from the priors.
    replicates : int
        Frames of every noise level, or of the calibration.
    method : {'laplace', 'mcmc'}, optional
        Maximum and Fisher information, the default of 'noise', or draws, the default of 'sbc'.
    seed : int
        Seed of every random number.
    background : tuple of float, optional, counts per pixel
        Noise levels; every combination of these and the following is one.
    flux : tuple of float, optional, counts
        Mean fluxes of the sources.
    sources : tuple of int, optional
        Numbers of sources: the brightest. Among equally bright ones, the most widely spaced.
    psf_sigma : tuple of float, optional, pixel
        Widths of the PSF.
    exposure : tuple of float, optional
        Factors of flux and background together.
    error : float, pixel
        The rms error of the displacement for which a noise study counts photons.
    path : str, optional
        The table of results, .ecsv, inside the folder that the study is started in.
    """

    kind: Literal["noise", "sbc"] = "noise"
    replicates: Annotated[int, Field(ge=2, le=10**7)] = 100
    method: Literal["laplace", "mcmc"] | None = None
    seed: Seed = 1
    background: tuple[Positive, ...] | None = None
    flux: tuple[Positive, ...] | None = None
    sources: tuple[Count, ...] | None = None
    psf_sigma: tuple[Positive, ...] | None = None
    exposure: tuple[Positive, ...] | None = None
    error: Positive = 0.01
    path: Annotated[str, Field(pattern=r"\.ecsv$")] | None = None


class DesignSettings(Section):
    """`[design]`: what `bayesfred design` asks of the frame that [simulation] describes.

    Attributes
    ----------
    error : float, pixel of the fine grid
        The rms error of the displacement over the field, along one axis, that is wanted.
    criterion : {'D', 'G'}
        What a choice is judged by: the volume of the coefficients' error ellipsoid, or the largest
        error of the displacement over the field.
    sources : int, optional
        How many sources to choose; by default the fewest that reach `error`, or all.
    dithers : tuple of (float, float), pixel of the fine grid
        Pointings to choose from, by how far each displaces the catalogue along x and y; (0, 0) is
        the planned one.
    frames : int, optional
        How many frames to choose; by default the fewest that reach `error`, or one a pointing.
    path : str, optional
        The table of sources, .ecsv, inside the folder that the command is started in.
    """

    error: Positive = 0.01
    criterion: Literal["D", "G"] = "D"
    sources: Count | None = None
    dithers: tuple[tuple[Float, Float], ...] = ()
    frames: Count | None = None
    path: Annotated[str, Field(pattern=r"\.ecsv$")] | None = None
