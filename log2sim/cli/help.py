"""The pages of the cookbook, in the terminal."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli.options import say
from log2sim.errors import ConfigError

# In a wheel the pages lie in the package, in a checkout beside it.
PAGES = next(
    p for p in (Path(__file__).parents[1] / "cookbook", Path(__file__).parents[2] / "samples/cookbook") if p.is_dir()
)


def titles() -> dict[str, str]:
    """Return the heading of each page by its topic."""
    return {p.stem: p.read_text(encoding="utf-8").partition("\n")[0].lstrip("# ") for p in sorted(PAGES.glob("*.md"))}


def _topics() -> list[str]:
    return list(titles())


def help_(
    topic: Annotated[
        str | None, typer.Argument(help="Page to show; without one the pages are listed.", autocompletion=_topics)
    ] = None,
) -> None:
    """Show a page of the cookbook: a task, its commands, and what can go wrong.

    Examples
    --------
    log2sim help
    log2sim help doubts
    """
    known = titles()
    if topic is None:
        say("\n".join(f"{name:<11} {title}" for name, title in known.items()))
        return
    if topic not in known:
        near = difflib.get_close_matches(topic, known, n=1)
        raise ConfigError(f"no page '{topic}'{f', but {near[0]!r}' if near else ''}; log2sim help lists them")
    text = (PAGES / f"{topic}.md").read_text(encoding="utf-8").rstrip()
    say(re.sub(r"\[([^\]]+)\]\([^)\s]+\)", r"\1", text))
