"""Print the settings."""

from __future__ import annotations

from log2sim.cli.options import ConfigFile, Settings, say


def config(
    file: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """Print all settings as TOML.

    The defaults, or what a file and --set make of them.
    """
    from log2sim.config import Config

    say(Config.load(file, settings or ()).to_toml(comments=True).rstrip())
