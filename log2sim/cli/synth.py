"""Generate a synthetic log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli.options import Overwrite, Quiet, say


def synth(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene file.")],
    out: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log folder to write.")],
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Generate a synthetic log with exact ground truth."""
    from log2sim.cli.progress import progress
    from log2sim.synth.scene import load_scene
    from log2sim.synth.write import write_synthetic

    loaded = load_scene(scene)
    with progress(quiet=quiet) as report_progress:
        write_synthetic(
            loaded,
            out,
            seed=seed,
            overwrite=overwrite,
            progress=lambda done, total: report_progress("synthesize", done, total),
        )
    say(f"{out}: written", quiet=quiet)
