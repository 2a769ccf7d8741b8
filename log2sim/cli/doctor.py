"""Show what is installed, and what is missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

from log2sim.cli.options import AsJson, fail, say

if TYPE_CHECKING:
    from log2sim.cli.installation import Installation

BROKEN_CODE = 5
"""As where an extra is missing: something has to be installed."""


def doctor(
    as_json: AsJson = False,
) -> None:
    """Show versions, extras, models, cache and processors, and what is missing with the line that installs it.

    Exits with 0, or with 5 when something is broken that every command needs; a missing extra is not.

    Examples
    --------
    log2sim doctor
    log2sim doctor --json
    """
    import json

    from log2sim.cli.installation import examine

    found = examine()
    say(json.dumps(found.to_dict(), indent=2) if as_json else "\n".join(describe(found)))
    if found.broken:
        fail("; ".join(found.broken), BROKEN_CODE)


def describe(found: Installation) -> list[str]:
    """Describe an installation in lines for people."""
    from log2sim.cli.tables import format_rows

    cores = f"{found.usable_cores} of {found.cores} cores"
    limits = ", ".join(f"{name}={value}" for name, value in found.threads.items())
    facts = [
        ("log2sim", found.log2sim),
        ("Python", f"{found.python}, {found.program}"),
        ("system", found.system),
        ("processor", f"{cores}, {limits}" if limits else cores),
        ("cache", f"{found.cache}, {found.cache_bytes / 1e6:.0f} MB"),
        ("browser", found.browser or "none found; open the pages of log2sim view on another machine"),
    ]
    packages = [(p.name, p.version or "-", p.state) for p in found.packages]
    extras = [
        (extra.name, "missing" if extra.missing else "installed", extra.purpose, extra.install if extra.missing else "")
        for extra in found.extras
        if extra.purpose
    ]
    lines = ["", *format_rows(facts)]
    lines += ["", "packages", *format_rows(packages, indent=2)]
    lines += ["", "detectors", *format_rows(list(found.models.items()), indent=2)]
    lines += ["", "extras", *format_rows([row[:3] for row in extras], indent=2)]
    absent = [extra for extra in found.extras if extra.purpose and extra.missing]
    lines += ["", "to add one:", *(f"  {extra.install}" for extra in absent)] if absent else []
    verdict = "nothing needed is missing" if not found.broken else f"{len(found.broken)} problems"
    return [*lines[1:], "", verdict]
