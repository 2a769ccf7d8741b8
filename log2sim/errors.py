"""Errors that log2sim raises, each with the exit code of the command line.

A caller's own mistake in a library call stays a `ValueError` or `TypeError`; everything that a log, a file or a setting
can cause is one of these. A message says where, what was found, what was expected and what to do.
"""

from __future__ import annotations


class Log2SimError(Exception):
    """Base of all errors that a user can cause and mend."""

    exit_code = 1


class ConfigError(Log2SimError):
    """A setting, option or name that is not known or out of its range."""

    exit_code = 2


class LogError(Log2SimError):
    """A log or an input file that is missing, unreadable, inconsistent or incomplete."""

    exit_code = 3


class ScenarioError(LogError):
    """A scenario, replay or truth file that breaks its schema or holds impossible values."""


class RecordError(LogError):
    """One image or sweep that cannot be read; the run counts it and goes on."""


class NothingToReconstruct(Log2SimError):
    """The log is fine, yet nothing in it can become an agent."""

    exit_code = 4


class MissingExtra(Log2SimError):
    """An optional dependency is not installed."""

    exit_code = 5

    def __init__(self, needed_for: str, extra: str) -> None:
        super().__init__(f"{needed_for} needs the extra '{extra}': pip install 'log2sim[{extra}]'")
        self.extra = extra


class CheckFailed(Log2SimError):
    """A limit asked for with --strict is broken."""

    exit_code = 6
