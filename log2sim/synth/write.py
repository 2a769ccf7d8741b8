"""Write a synthetic log, as sensors would have recorded it, with its exact truth.

scene = load_scene("samples/crossing.toml")
log, truth = synthesize(scene, seed=1)          # records are rendered and cast when they are read
write_synthetic(scene, "samples/crossing", seed=1)
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from log2sim.documents import check_folder
from log2sim.errors import ConfigError
from log2sim.output_folders import replaced_folder
from log2sim.synth.scene import Scene, load_scene

if TYPE_CHECKING:
    from log2sim.datatypes import Log, Scenario

__all__ = ["Scene", "load_scene", "synthesize", "write_synthetic"]

TRUTH_FILE = "truth.json"
MANIFEST = "log.json"


def synthesize(scene: Scene, *, seed: int = 0, observe: bool = True) -> tuple[Log, Scenario]:
    """Make a log and its exact truth; see `log2sim.synth.synthesis.synthesize`."""
    from log2sim.synth import synthesis

    return synthesis.synthesize(scene, seed=seed, observe=observe)


def write_synthetic(
    scene: Scene,
    out: Path | str,
    *,
    seed: int = 0,
    overwrite: bool = False,
    jpeg_quality: int = 85,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Write a scene's log as a native log folder with its truth as `truth.json` in it, whole or not at all.

    Parameters
    ----------
    out
        The folder; one that is there already is replaced only with `overwrite`, and only if it is a log.
    jpeg_quality
        1 to 100.
    progress
        Called as `progress(done, total)` after each record.

    Raises
    ------
    ConfigError
        When the folder may not be replaced or cannot be written.
    """
    from log2sim.logs.native.writer import write_log

    target = Path(out)
    _refuse(target, overwrite)
    check_folder(target, overwrite=overwrite)
    log, truth = synthesize(scene, seed=seed)
    poses: Literal["gnss", "poses"] = scene.ego.poses if scene.ego is not None else "poses"
    with replaced_folder(target, overwrite=overwrite) as folder:
        write_log(log, folder, jpeg_quality=jpeg_quality, ego=poses, progress=progress)
        truth.save(folder / TRUTH_FILE)


def _refuse(target: Path, overwrite: bool) -> None:
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not overwrite:
        raise ConfigError(f"{target}: exists already; choose another name or pass --overwrite")
    if not (target / MANIFEST).is_file():
        raise ConfigError(f"{target}: exists and is no log folder, so it is not replaced; choose another name")
