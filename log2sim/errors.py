"""Errors that log2sim raises, each with the exit code of the command line.

A caller's own mistake in a library call stays a `ValueError` or `TypeError`; everything that a log, a file or a setting
can cause is one of these. A message says where, what was found, what was expected and what to do.
"""

from __future__ import annotations

import json
from pathlib import Path


class Log2SimError(Exception):
    """Base of all errors that a user can cause and correct."""

    exit_code = 1


class ConfigError(Log2SimError):
    """A setting, option or name that is unknown or out of range."""

    exit_code = 2


class PluginError(ConfigError):
    """A plug-in of another package that cannot be imported, lacks something, or does what no plug-in of its kind may."""


class LogError(Log2SimError):
    """A log or an input file that is missing, unreadable, inconsistent or incomplete."""

    exit_code = 3


class ScenarioError(LogError):
    """A scenario, replay or truth file that violates its schema or has impossible values."""


class RecordError(LogError):
    """One image or sweep that cannot be read; the run counts it and goes on."""


class NothingToReconstruct(Log2SimError):
    """A valid log without ego poses in which no object was detected."""

    exit_code = 4


class MissingExtra(Log2SimError):
    """An optional dependency is not installed."""

    exit_code = 5

    def __init__(self, needed_for: str, extra: str) -> None:
        super().__init__(f"{needed_for} needs the extra '{extra}': {install_command(extra)}")
        self.extra = extra


class CheckFailed(Log2SimError):
    """A limit was exceeded and --strict was given."""

    exit_code = 6


class LogsFailed(Log2SimError):
    """Some logs of many could not be reconstructed; the others were."""

    exit_code = 7


def install_command(extra: str) -> str:
    """Return the pip command that adds an extra of log2sim, such as "coco", to this installation.

    It names the checkout where log2sim runs from one or was installed from one, the repository or archive where it was installed
    from that, and the package index otherwise: pip records the origin of an installation in `direct_url.json` (PEP 610); a package
    from an index has no such file.
    """
    checkout = Path(__file__).resolve().parents[1]
    if (checkout / "pyproject.toml").is_file():
        return f"pip install --editable '{checkout}[{extra}]'"
    # Imported here: every command loads this module, and these imports take longer than the rest of it.
    from importlib.metadata import PackageNotFoundError, distribution
    from urllib.parse import urlsplit
    from urllib.request import url2pathname

    try:
        origin = dict(json.loads(distribution("log2sim").read_text("direct_url.json") or "{}"))
    except (PackageNotFoundError, ValueError):
        origin = {}
    url = origin.get("url", "")
    if "dir_info" in origin:
        return f"pip install '{url2pathname(urlsplit(url).path)}[{extra}]'"
    if "vcs_info" in origin:
        return f"pip install 'log2sim[{extra}] @ {origin['vcs_info']['vcs']}+{url}'"
    return f"pip install 'log2sim[{extra}]{f' @ {url}' if url else ''}'"
