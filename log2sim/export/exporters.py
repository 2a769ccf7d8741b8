"""Exporters: each format is a plug-in that writes into an empty folder; see `Exporter`."""

from __future__ import annotations

import errno
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Protocol

from log2sim import registry
from log2sim.datatypes import Log, Scenario
from log2sim.documents import check_folder, refuse_existing
from log2sim.errors import ConfigError
from log2sim.export.checks import require_exportable
from log2sim.output_folders import unfinished_folder
from log2sim.outputs import expect_new, place_all, temporary_beside, written_meanwhile

__all__ = ["Exporter", "Options", "export", "formats"]


@dataclass(frozen=True)
class Options:
    """Options of an export; None leaves the choice to the format, which lists the options that it takes.

    Attributes
    ----------
    revision : str or None
        Of the format's standard.
    map : Path or None
        A road network to use in place of an inferred one.
    mode : str or None
        "exact" or "pid", for scripts that move agents.
    log : Log or None
        The opened log, for formats that also hold its images and points.
    """

    revision: str | None = None
    map: Path | None = None
    mode: str | None = None
    log: Log | None = None


class Exporter(Protocol):
    """A format that scenarios can be written in."""

    @property
    def options(self) -> tuple[str, ...]:
        """Names of the fields of `Options` that the format takes."""
        ...

    @property
    def loses(self) -> str:
        """What of a scenario the format cannot hold."""
        ...

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        """Write files into an empty folder that exists.

        Raises
        ------
        ConfigError
            When the value of an option cannot be used.
        MissingExtra
            When what the format needs is not installed.
        ScenarioError
            When the format cannot hold the scenario at all; names the agent and the reason.
        """
        ...


def formats() -> list[str]:
    """Return the names of all formats, built-in ones first."""
    return registry.names("export")


def export(
    scenario: Scenario,
    to: str,
    out: Path | str,
    options: Options | None = None,
    *,
    quarantined: bool = False,
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write a scenario in the format `to` into the folder `out`, all files or none; return them in order of name.

    Agents whose confidence is too low (`Agent.quarantined`) are left out unless `quarantined` says otherwise.

    Raises
    ------
    ConfigError
        For an unknown format, an option that it does not understand, or files that exist and may not be replaced.
    ScenarioError
        When the scenario breaks what players of the formats rely on; see `log2sim.export.checks`.
    """
    exporter: Exporter = registry.load("export", to)
    chosen = options or Options()
    for field in fields(Options):
        if getattr(chosen, field.name) is not None and field.name not in exporter.options:
            known = ", ".join(f"--{name}" for name in exporter.options) or "none"
            raise ConfigError(f"--{field.name}: format '{to}' has no such option; it has {known}")
    scenario = scenario if quarantined else scenario.active
    require_exportable(scenario)
    folder = Path(out)
    check_folder(folder, overwrite=overwrite)
    # In the folder itself if it exists, since it may be on another file system than its parent.
    parent = folder if folder.is_dir() else folder.parent
    with unfinished_folder(temporary_beside(parent / folder.name), folder) as temporary:
        with registry.blaming("export", to):
            exporter.write(scenario, temporary, chosen)
        return _move_into(temporary, folder, overwrite=overwrite)


def with_ego(scenario: Scenario, agent: str) -> Scenario:
    """Call one of the agents "ego", as scenarios of roadside sensors need it for formats with an ego.

    Raises
    ------
    ConfigError
        When the scenario has another ego or no such agent.
    """
    ids = [a.id for a in scenario.agents]
    if agent not in ids:
        known = ", ".join(ids) or "none"
        raise ConfigError(f"--ego: no agent '{agent}'{registry.nearest(agent, ids)}; the scenario has {known}")
    if scenario.ego is not None and agent != "ego":
        raise ConfigError(f"--ego {agent}: scenario '{scenario.name}' has an ego already; leave the option out")
    agents = tuple(replace(a, id="ego") if a.id == agent else a for a in scenario.agents)
    return replace(scenario, agents=agents)


def with_doubtful(scenario: Scenario, choice: str) -> Scenario:
    """Return a scenario with its doubtful agents but the quarantined ("keep"), without ("drop"), or with all of them ("all").

    Raises
    ------
    ConfigError
        For another choice.
    """
    choices = {"keep": scenario.active, "drop": scenario.without_doubtful(), "all": scenario}
    if choice not in choices:
        raise ConfigError(f"--doubtful: '{choice}', expected {', '.join(choices)}")
    return choices[choice]


def _move_into(temporary: Path, folder: Path, *, overwrite: bool) -> tuple[Path, ...]:
    """Move all files of a folder into another, after checking that all may be written."""
    names = sorted(p.relative_to(temporary) for p in temporary.rglob("*") if p.is_file())
    for name in names:
        refuse_existing(folder / name, overwrite=overwrite)
        if (folder / name).is_dir():
            raise ConfigError(f"{folder / name}: is a folder, where a file would be written; choose another folder")
    targets = tuple(folder / name for name in names)
    if not folder.exists():
        try:
            temporary.rename(folder)  # all files at once
        except OSError as error:
            if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise written_meanwhile(folder) from None
            raise
        return targets
    if not overwrite:
        expect_new(targets)
    place_all([(temporary / name, folder / name) for name in names])
    return targets
