"""Runs commands as in an environment that holds log2sim and what it requires, but none of its extras.

    python tests/base_only.py '[["doctor"], ["export", "s.json", "--to", "osi", "-o", "osi/"]]'

prints exit code and standard error of each. A program of its own, since modules that are imported cannot be taken away.
"""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Sequence
from importlib import metadata
from importlib.machinery import PathFinder
from typing import Any
from unittest import mock

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name


def required(package: str) -> set[str]:
    """Names of a package and of all that it needs without extras."""
    found, waiting = set(), [package]
    while waiting:
        name = canonicalize_name(waiting.pop())
        if name in found:
            continue
        found.add(name)
        with contextlib.suppress(metadata.PackageNotFoundError):
            lines = map(Requirement, metadata.requires(name) or ())
            waiting += [r.name for r in lines if r.marker is None or r.marker.evaluate({"extra": ""})]
    return found


class BaseFinder(PathFinder):
    """Finds modules as usual, but none of a distribution that is not required."""

    # The second part: modules that are a compiled file alone are in no list of packages.
    owners = metadata.packages_distributions() | {d.name.replace("-", "_"): [d.name] for d in metadata.distributions()}
    kept = required("log2sim")

    @classmethod
    def find_spec(cls, fullname: str, path: Sequence[str] | None = None, target: Any = None) -> Any:
        distributions = map(canonicalize_name, cls.owners.get(fullname.partition(".")[0], ()))
        known = fullname.partition(".")[0] in cls.owners
        return None if known and cls.kept.isdisjoint(distributions) else super().find_spec(fullname, path, target)


def main() -> None:
    sys.meta_path[sys.meta_path.index(PathFinder)] = BaseFinder
    from log2sim.cli import entry

    ran = []
    for command in json.loads(sys.argv[1]):
        err = io.StringIO()
        with (
            mock.patch.object(sys, "argv", ["log2sim", *command]),
            contextlib.redirect_stdout(io.StringIO()),
            contextlib.redirect_stderr(err),
        ):
            try:
                entry.main()
            except SystemExit as stop:
                ran.append([int(stop.code or 0), err.getvalue()])
    sys.stdout.write(json.dumps(ran))


if __name__ == "__main__":
    main()
