"""The pages of the cookbook, in the terminal."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli import options as opt
from log2sim.errors import ConfigError
from log2sim.files.plugins import nearest


def pages() -> dict[str, str]:
    """Return the text of each page by its topic; in a wheel they lie in the package, in a checkout in its samples."""
    package = Path(__file__).parents[1]
    folder = package / "cookbook" if (package / "cookbook").is_dir() else package.parent / "samples/cookbook"
    return {page.stem: page.read_text(encoding="utf-8") for page in sorted(folder.glob("*.md"))}


def help(
    topic: Annotated[
        str | None,
        typer.Argument(help="Page to show; without one the pages are listed.", autocompletion=lambda: list(pages())),
    ] = None,
) -> None:
    """Show a page of the cookbook: a task, its commands, and what can go wrong.

    Examples
    --------
    log2sim help
    log2sim help doubts
    """
    known = pages()
    if topic is None:
        opt.say("\n".join(f"{name:<11} {text.partition(chr(10))[0].lstrip('# ')}" for name, text in known.items()))
        return
    if topic not in known:
        raise ConfigError(f"no page '{topic}'{nearest(topic, list(known))}; log2sim help lists them")
    text = re.sub(r"^!\[.*\n\n?", "", known[topic].rstrip(), flags=re.MULTILINE)
    opt.say(re.sub(r"\[([^\]]+)\]\([^)\s]+\)", r"\1", text))
