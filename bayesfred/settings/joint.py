"""Run files of many frames of one instrument: `[[frames]]` and `[joint]`.

The sections of the file hold for every frame. An entry of `[[frames]]` says what is the frame's
own: keys of `[frame]`, such as `path`, and tables of other sections, which are merged into the
file's key by key; one that says its `kind` replaces the file's. So every frame has the settings of
a run of its own.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field, ValidationError, create_model, model_serializer

from bayesfred._typing import PathLike
from bayesfred.errors import printable
from bayesfred.io.serialize import TAGS
from bayesfred.settings.frame import FrameSettings
from bayesfred.settings.run import (
    OutputSettings,
    PriorSettings,
    RunSettings,
    SamplingSettings,
    checked,
    read_settings,
    refused,
    run_table,
)
from bayesfred.settings.sections import Float, Name, Positive, Section, mistake

__all__ = ["JointRun", "JointSettings", "read_run"]

SECTIONS = (
    "frame", "catalogue", "sky", "detector", "psf", "distortion", "model", "noise", "nuisances",
    "prior",
)  # fmt: skip
# An entry's `name` is the frame's; that of a FITS extension is a key of its table `frame`.
FRAME_KEYS = tuple(key for key in FrameSettings.model_fields if key != "name")
NAME = re.compile(r"\w[\w-]{0,99}")  # of a frame: parts of file names and of parameters' names
SUFFIXES = re.compile(r"(\.(fits|fit|fts|h5|hdf5|npy|png|tiff?|gz|fz))+$", re.IGNORECASE)


class DriftSettings(Section):
    """`[joint.drift]`: how shared terms change with time, see `bayesfred.model.drift`.

    Attributes
    ----------
    terms : tuple of str, optional
        By default all of the distortion's that are shared.
    walk : float, optional, pixel
        A random walk in place of straight lines: by how much a term's largest displacement changes
        in a unit of time.
    """

    terms: tuple[Name, ...] | None = None
    walk: Positive | None = None


class JointSettings(Section):
    """`[joint]`: what the frames have in common.

    Attributes
    ----------
    shared : tuple of str, optional
        Parameters that all frames share; by default the distortion's terms of degree 2 and higher.
    drift : DriftSettings, optional
        How shared terms change; by default they do not.
    """

    shared: tuple[Name, ...] | None = None
    drift: DriftSettings | None = None


class JointRun(Section):
    """A run of many frames.

    Attributes
    ----------
    frames : dict of str to RunSettings
        The settings of each frame, by its name.
    times : dict of str to float
        When frames were taken, where that is said.
    joint : JointSettings
    prior : dict of PriorSettings
        Priors of what only all frames together have: names with a point in them.
    sampling : SamplingSettings
    output : OutputSettings
    """

    frames: dict[str, RunSettings]
    times: dict[str, float]
    joint: JointSettings
    prior: dict[str, PriorSettings]
    sampling: SamplingSettings
    output: OutputSettings

    @model_serializer
    def _run_file(self) -> dict[str, Any]:
        """The tables of the run file: what all frames have in common, and what is their own."""
        runs = [
            run.model_dump(include=set(SECTIONS), exclude_none=True) for run in self.frames.values()
        ]
        common = _common(runs)
        prior = {name: prior.model_dump() for name, prior in self.prior.items()}
        parts = {"joint": self.joint, "sampling": self.sampling, "output": self.output}
        return {
            **common,
            "prior": {**common.get("prior", {}), **prior},
            **{name: part.model_dump(exclude_none=True) for name, part in parts.items()},
            "frames": [
                self._entry(name, _less(run, common))
                for name, run in zip(self.frames, runs, strict=True)
            ],
        }

    def _entry(self, name: str, own: dict[str, Any]) -> dict[str, Any]:
        frame = own.pop("frame")
        stored = {"frame": {"name": frame.pop("name")}} if "name" in frame else {}
        time = {"time": self.times[name]} if name in self.times else {}
        return {"name": name, **time, **frame, **stored, **own}


_Table = dict[str, Any] | None
_Entry = create_model(
    "_Entry",
    __base__=Section,
    name=(Name | None, None),
    time=(Float | None, None),
    **dict.fromkeys(FRAME_KEYS, (Any, None)),
    **dict.fromkeys(SECTIONS, (_Table, None)),
)  # type: ignore[call-overload]


class _File(Section):
    """What of a run file concerns many frames; `frames` are checked each by itself."""

    model_config = ConfigDict(extra="ignore")

    frames: Annotated[tuple[_Entry, ...], Field(min_length=2)]  # type: ignore[valid-type]
    joint: JointSettings = JointSettings()
    prior: dict[str, PriorSettings] = Field(default_factory=dict)


def read_run(path: PathLike) -> RunSettings | JointRun:
    """Read and check a run file, of one frame or of many.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    RunSettings or JointRun

    Raises
    ------
    InputError
        As `bayesfred.settings.read_settings` does; if a frame has no name that files can have, or
        that of another, or a drift no times.
    """
    path = Path(path)
    table = run_table(path)
    if not table.keys() & {"frames", "joint"}:
        return read_settings(path)
    try:
        file: Any = _File.model_validate_json(json.dumps(table, default=str))
    except ValidationError as error:
        errors = error.errors(include_url=False)
        raise refused(path, [mistake(details, _File, table) for details in errors]) from None
    entries = table.pop("frames")
    table.pop("joint", None)
    joint_prior = {name: prior for name, prior in file.prior.items() if "." in name}
    table["prior"] = {n: p for n, p in table.get("prior", {}).items() if n not in joint_prior}
    names = [_name(entry) for entry in entries]
    mistakes = _mistakes(table, names, file)
    if mistakes:
        raise refused(path, mistakes)
    runs, mistakes = _runs(table, dict(zip(names, entries, strict=True)))
    if mistakes:
        raise refused(path, mistakes)
    first = runs[names[0]]
    times = {n: e.time for n, e in zip(names, file.frames, strict=True) if e.time is not None}
    return JointRun(
        frames=runs, times=times, joint=file.joint, prior=joint_prior, sampling=first.sampling,
        output=first.output,
    )  # fmt: skip


def _name(entry: dict[str, Any]) -> str:
    """A frame's name: what is said, or that of its file without suffixes."""
    given = entry.get("name") or SUFFIXES.sub("", Path(str(entry.get("path", ""))).name)
    return str(given)


def _mistakes(table: dict[str, Any], names: list[str], file: Any) -> list[str]:
    """What is wrong with the frames as a whole."""
    found = []
    if isinstance(table.get("frame", {}), dict) and "path" in table.get("frame", {}):
        found.append("frame.path: got it beside [[frames]], expected the path of each frame there")
    for k, name in enumerate(names):
        if name in TAGS or not NAME.fullmatch(name):
            found.append(
                f"frames.{k}.name: got {printable(repr(name))}, expected letters, digits, - and _: "
                "give name, or another one"
            )
    for folded, number in Counter(name.casefold() for name in names).items():
        if number > 1 and not found:
            found.append(
                f"frames: got {number} of the name {folded!r}, expected one of each: give name"
            )
    if file.joint.drift is not None:
        without = [n for n, e in zip(names, file.frames, strict=True) if e.time is None]
        if without:
            found.append(
                f"frames: got no time of {', '.join(without)}, expected that of every frame with "
                "joint.drift"
            )
    if isinstance(terms := table.get("distortion"), dict) and terms.get("terms") == "choose":
        found.append(
            "distortion.terms: got 'choose', expected the terms themselves, which frames share: "
            "choose them on one frame"
        )
    return found


def _runs(
    table: dict[str, Any], entries: dict[str, dict[str, Any]]
) -> tuple[dict[str, RunSettings], list[str]]:
    """The settings of every frame, and every mistake; one that all frames have is said once."""
    runs, wrong = {}, {}
    for name, entry in entries.items():
        frame = {key: entry[key] for key in FRAME_KEYS if key in entry}
        own = {key: entry[key] for key in SECTIONS if key in entry}
        run, wrong[name] = checked(_merged(_merged({"frame": {}, **table}, own), {"frame": frame}))
        if run is not None:
            runs[name] = run
    common = [m for m in next(iter(wrong.values())) if all(m in each for each in wrong.values())]
    return runs, [
        *common,
        *(
            f"frames.{name}.{mistake.removeprefix('frame.')}"
            for name, each in wrong.items()
            for mistake in each
            if mistake not in common
        ),
    ]


def _merged(table: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """A table with another's keys in place of its own; one that says its kind replaces it."""
    if "kind" in own:
        return own
    both = {**table, **own}
    for key, value in own.items():
        if isinstance(value, dict) and isinstance(table.get(key), dict):
            both[key] = _merged(table[key], value)
    return both


def _common(tables: list[dict[str, Any]]) -> dict[str, Any]:
    """What several tables have in common; nothing where they are of several kinds."""
    first = tables[0]
    if any(table.get("kind") != first.get("kind") for table in tables):
        return {}
    common = {}
    for key, value in first.items():
        values = [table.get(key) for table in tables]
        if all(isinstance(each, dict) for each in values):
            common[key] = _common(values)  # type: ignore[arg-type]
        elif all(each == value for each in values):
            common[key] = value
    return common


def _less(table: dict[str, Any], common: dict[str, Any]) -> dict[str, Any]:
    """A table without what it has in common with others."""
    own = {}
    for key, value in table.items():
        if isinstance(value, dict) and isinstance(common.get(key), dict):
            if part := _less(value, common[key]):
                own[key] = part
        elif key not in common:
            own[key] = value
    return own
