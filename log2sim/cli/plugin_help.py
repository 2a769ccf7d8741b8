"""Help of a command that ends with the plug-ins of other packages that its options take."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from typer.core import TyperCommand

# Kinds of plug-ins that an option takes, and what stands before their names.
KINDS = {
    "--format": {"log": ""},
    "--detector": {"detector": "", "lidar_detector": "lidar:"},
    "--to": {"export": ""},
    "--ego": {"policy": ""},
    "--model": {"vehicle_model": ""},
}

# Commands of which alone an option means that; `export --ego` takes the id of an agent.
ONLY_OF = {"--ego": "replay", "--model": "replay"}

SWEEPS_ALONE = "detect"  # command whose `--detector` takes none in pictures


class CommandWithPlugins(TyperCommand):
    """A command whose help names installed plug-ins; they are looked up only then, and none is imported."""

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the installed plug-ins by option, then the examples."""
        options = {name for parameter in self.params for name in parameter.opts}
        found = []
        for option in [o for o in KINDS if o in options and ONLY_OF.get(o, self.name) == self.name]:
            kinds = {k: prefix for k, prefix in KINDS[option].items() if (self.name, k) != (SWEEPS_ALONE, "detector")}
            found += [(f"{option} {name}", package) for name, package in list_plugins(kinds)]
        if found:
            with formatter.section("Plug-ins that are installed"):
                formatter.write_dl(found)
        super().format_epilog(ctx, formatter)


def list_plugins(kinds: Mapping[str, str]) -> list[tuple[str, str]]:
    """List names, each behind the prefix of its kind, and packages of plug-ins, without importing them."""
    from log2sim.files.plugins import installed, package_of

    return [
        (f"{prefix}{entry.name}", package_of(entry))
        for kind, prefix in kinds.items()
        for entry in sorted(installed(kind), key=lambda entry: entry.name)
    ]
