"""Print all settings with their meaning."""

from __future__ import annotations

from log2sim.cli import options as opt


def config(file: opt.ConfigFile = None, settings: opt.Settings = None) -> None:
    """Print all settings as TOML.

    Each with its meaning, unit, choices and default; with --config or --set, the values that these give.

    Examples
    --------
    log2sim config
    log2sim config --set smooth.enabled=false
    """
    from log2sim.config import Config

    opt.say(Config.load(file, settings or ()).to_toml(comments=True).rstrip())
