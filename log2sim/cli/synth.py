"""Generate synthetic data: the log of a scene file, or random traffic."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from log2sim.cli import options as opt
from log2sim.errors import ConfigError


def synth(
    out: Annotated[Path, opt.write_to("DIR", "Folder to write.")],
    scene: Annotated[Path | None, typer.Argument(metavar="[SCENE.toml]", help="Scene file.")] = None,
    traffic: Annotated[Literal["vehicle", "roadside"] | None, opt.option(
        "Instead of a scene file: random traffic around a LiDAR on a vehicle or at the roadside.")] = None,
    scenes: Annotated[int, opt.option("Number of random scenes.", min=1, max=1_000_000)] = 10,
    sensor: Annotated[str | None, opt.option(
        "LiDAR of random scenes: a name, a TOML file, or random. [default: hdl64e, rslidar16-roadside]",
        "NAME")] = None,
    layout: Annotated[Literal["kitti", "log2sim"] | None, opt.option(
        "Layout of random scenes: KITTI's object layout or a log folder each. [default: kitti, log2sim without "
        "pictures]")] = None,
    duration: Annotated[float, opt.option("Length of each log of random traffic in s.", min=0.5, max=60.0)] = 5.0,
    light: Annotated[Literal["noon", "overcast", "dusk", "night"] | None, opt.option(
        "Light; random scenes draw it otherwise.")] = None,
    weather: Annotated[Literal["clear", "rain", "fog"] | None, opt.option(
        "Weather; random scenes draw it otherwise.")] = None,
    no_pictures: Annotated[bool, opt.option(
        "Write no cameras: LiDAR sweeps, poses and labels alone.", None, "--no-pictures")] = False,
    seed: Annotated[int, opt.option("Seed of all random numbers.", min=0)] = 0,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Generate a synthetic log with exact ground truth, or random traffic for training and tests.

    Examples
    --------
    log2sim synth samples/crossing.toml -o log/
    log2sim synth --traffic vehicle --scenes 100 -o scenes/
    log2sim synth --traffic roadside --no-pictures --duration 2 -o clouds/
    """
    from log2sim.cli.progress import progress
    from log2sim.synth.scene import load_scene
    from log2sim.synth.synthesis import write_synthetic

    if (scene is None) == (traffic is None):
        raise ConfigError("give either a scene file or --traffic vehicle or --traffic roadside")
    with progress(quiet=quiet) as report_progress:
        if scene is not None:
            loaded = load_scene(scene)
            changes = {k: v for k, v in (("light", light), ("weather", weather)) if v is not None}
            if no_pictures and not loaded.lidar:
                raise ConfigError(f"{scene}: has no LiDAR, so that nothing is left without pictures")
            cameras = () if no_pictures else loaded.camera
            environment = loaded.environment.model_copy(update=changes)
            write_synthetic(
                loaded.model_copy(update={"environment": environment, "camera": cameras}),
                out,
                seed=seed,
                overwrite=overwrite,
                progress=partial(report_progress, "synthesize"),
            )
        elif traffic is not None:
            from log2sim.synth.traffic_data import TrafficSettings, write_traffic

            chosen = layout or ("log2sim" if no_pictures else "kitti")
            settings = TrafficSettings(
                traffic, scenes, seed, sensor, chosen, duration, light, weather, pictures=not no_pictures
            )  # fmt: skip
            write_traffic(settings, out, overwrite=overwrite, progress=partial(report_progress, "scenes"))
    opt.report_written(out, quiet=quiet)
