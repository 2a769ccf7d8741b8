"""What is installed and missing, set and kept, and the cookbook."""

from __future__ import annotations

import importlib
import json
import os
import platform
import re
import shutil
import sys
import tomllib
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import typer
from packaging.requirements import InvalidRequirement, Requirement

from log2sim.cli import options as opt
from log2sim.errors import ConfigError, Log2SimError, install_command
from log2sim.files.plugins import nearest
from log2sim.files.version import __version__

MIN_PYTHON = (3, 11)
BROKEN_CODE = 5  # as where an extra is missing: something has to be installed
# Modules of packages whose names differ by more than a hyphen.
MODULES = {"opencv-contrib-python-headless": "cv2", "scikit-image": "skimage"}
# Extras for users, and what for; others are for development.
PURPOSES = {
    "coco": "the default detector in images",
    "video": ".mp4 as H.264",
    "cluster": "log2sim batch",
    "gym": "the gymnasium environment",
    "osi": "export --to osi",
    "mcap": "export --to mcap",
    "ros": "ROS bags and MCAP as logs",
    "pandaset": "sweeps of PandaSet in half the time",
    "parquet": "Argoverse 2 and Waymo's parquet as logs, to_parquet",
    "dataframe": "scenario.to_dataframe",
    "xarray": "scenario.to_xarray",
    "find": "log2sim find, vary and test",
    "odometry": "--poses lidar and auto",
    "rerun": "export --to rerun",
    "carla": "replay --simulator carla",
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "firefox")
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def examine() -> dict[str, Any]:
    """Look at everything, for `log2sim doctor`; imports all packages that log2sim needs.

    "log2sim", "python" and "system" are versions, "program" is the Python that runs. "packages", those that are needed, have a
    "version", None where it is missing, a "state" ("ok", "missing", "outdated", or "broken": it is there and cannot be imported) and
    a "problem" for people. "extras" have the packages that are "missing" or too old, a "purpose", empty where they are for
    development, and a line for the shell to "install" them. "models": by detector "ready", or what it needs. "cache" is its folder.
    "threads": variables of the environment that limit threads. "browser": one that shows the pages of `log2sim view`, or None.
    "broken": what is needed and does not work, each with what to do.
    """
    from log2sim.files.cache import cache_folder

    # What log2sim requires: from the checkout it runs from, else from the installed package.
    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if project.is_file():
        table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        by_extra = {"": table["dependencies"], **table["optional-dependencies"]}
    else:
        by_extra = {}
        for line in metadata.requires("log2sim") or []:
            text, _, extra = line.partition("extra == ")
            by_extra.setdefault(extra.strip("'\") "), []).append(text.rstrip(" ;(").removesuffix(" and"))
    requirements: dict[str, list[Requirement]] = {}
    for extra, lines in by_extra.items():
        requirements[extra] = []
        for line in lines:
            with suppress(InvalidRequirement):
                requirements[extra].append(Requirement(line))
    packages = [_examine_package(r) for r in requirements.pop("")]
    extras = []
    for extra in sorted(requirements, key=lambda name: (name not in PURPOSES, name)):
        needed = [r for r in requirements[extra] if r.marker is None or r.marker.evaluate()]
        missing = [r.name for r in needed if not _is_met(r, version_of(r.name))]
        purpose = PURPOSES.get(extra, "")
        extras.append({"name": extra, "missing": missing, "purpose": purpose, "install": install_command(extra)})
    cache, cache_bytes = cache_folder(), 0
    for place, _, files in os.walk(cache):
        for file in files:
            with suppress(OSError):  # gone in the meantime
                cache_bytes += os.lstat(os.path.join(place, file)).st_size
    broken = [f"{p['name']}: {p['problem']}" for p in packages if p["problem"]]
    if sys.version_info < MIN_PYTHON:
        wanted = ".".join(map(str, MIN_PYTHON))
        broken.insert(0, f"Python {platform.python_version()} is too old: log2sim needs {wanted}")
    # The built-in detectors with what they need; `broken` takes what should be there and is not
    folder = Path(__file__).resolve().parents[1] / "perception" / "detect3d" / "weights"
    models = {}
    for name in ("vehicle", "roadside"):
        model = folder / f"{name}.onnx"
        models[f"lidar:{name}"] = "ready" if model.is_file() else f"{model} is missing"
        broken += [] if model.is_file() else [f"{model}: is missing; install log2sim again"]
    try:
        from log2sim.perception.detect.ssd_mobilenet import NAME, graph_bytes

        state = "ready"
        if not any(cache.glob(f"{NAME}-*.onnx")):
            graph_bytes()
            state = "ready; converted into the cache at its first use"
    except (Log2SimError, ImportError) as error:
        state = str(error)
    return {
        "log2sim": __version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "program": sys.executable,
        "packages": packages,
        "extras": extras,
        "models": models | {"ssd-mobilenet-v2": state},
        "cache": str(cache),
        "cache_bytes": cache_bytes,
        "cores": os.cpu_count() or 1,
        "usable_cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1,
        "threads": {name: os.environ[name] for name in THREAD_VARIABLES if os.environ.get(name)},
        "browser": next((found for name in BROWSERS if (found := shutil.which(name))), None),
        "broken": broken,
    }


def _examine_package(requirement: Requirement) -> dict[str, Any]:
    """Import a package that is needed, and compare its version with what is required."""
    name, wanted = requirement.name, f"pip install '{requirement.name}{requirement.specifier}'"
    version, state, problem = version_of(name), "ok", ""
    try:
        module = importlib.import_module(MODULES.get(name, name.replace("-", "_")))
    except Exception as error:  # whatever a broken package raises
        state, problem = "missing", f"is missing: {wanted}"
        if version is not None:
            state, problem = "broken", f"cannot be imported: {type(error).__name__}: {error}"
    else:
        version = version or str(getattr(module, "__version__", "")) or None  # the module of another distribution
        if version is not None and not _is_met(requirement, version):
            state, problem = "outdated", f"{version} is too old: {wanted}"
    return {"name": name, "version": version, "state": state, "problem": problem}


def _is_met(requirement: Requirement, version: str | None) -> bool:
    return version is not None and requirement.specifier.contains(version, prereleases=True)


def version_of(name: str) -> str | None:
    """Return the version of an installed package; None without it."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def doctor(as_json: opt.AsJson = False) -> None:
    """Show versions, extras, models, cache and processors, and what is missing with the line that installs it.

    Exits with 0, or with 5 when something is broken that every command needs; a missing extra is not.

    Examples
    --------
    log2sim doctor
    log2sim doctor --json
    """
    found = examine()
    if as_json:
        opt.say(json.dumps(found, indent=2))
    else:
        limits = "".join(f", {name}={value}" for name, value in found["threads"].items())
        extras = [extra for extra in found["extras"] if extra["purpose"]]
        absent = [f"  {extra['install']}" for extra in extras if extra["missing"]]
        lines = opt.format_rows([
            ("log2sim", found["log2sim"]),
            ("Python", f"{found['python']}, {found['program']}"),
            ("system", found["system"]),
            ("processor", f"{found['usable_cores']} of {found['cores']} cores{limits}"),
            ("cache", f"{found['cache']}, {found['cache_bytes'] / 1e6:.0f} MB"),
            ("browser", found["browser"] or "none found; open the pages of log2sim view on another machine"),
        ])  # fmt: skip
        packages = [(p["name"], p["version"] or "-", p["state"]) for p in found["packages"]]
        lines += ["", "packages", *opt.format_rows(packages, indent=2)]
        lines += ["", "detectors", *opt.format_rows(list(found["models"].items()), indent=2)]
        states = [(e["name"], "missing" if e["missing"] else "installed", e["purpose"]) for e in extras]
        lines += ["", "extras", *opt.format_rows(states, indent=2)]
        lines += ["", "to add one:", *absent] if absent else []
        lines += ["", f"{len(found['broken'])} problems" if found["broken"] else "nothing needed is missing"]
        opt.say("\n".join(lines))
    if found["broken"]:
        opt.fail("; ".join(found["broken"]), BROKEN_CODE)


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


def cache(
    clear: Annotated[bool, opt.option("Remove all that is kept.", None, "--clear")] = False,
    max_mb: Annotated[int | None, opt.option(
        "Size of the cache from now on, for all runs; what was not used for longest is dropped. At first 2048.", "MB",
        default="as it is", min=0, max=2**30)] = None,
    as_json: opt.AsJson = False,
) -> None:  # fmt: skip
    """Show what is kept of earlier runs, so that nothing is detected and measured twice; limit it or remove it.

    The environment variable LOG2SIM_CACHE moves the folder.

    Examples
    --------
    log2sim cache
    log2sim cache --max-mb 8192
    """
    from log2sim.files.cache import DiskCache, detection_folder

    store = DiskCache(detection_folder())
    if max_mb is not None:
        store.set_limit(max_mb)
    removed = store.clear() if clear else None
    if removed is not None and not as_json:
        opt.say(f"{store.folder}: {opt.counted(removed, 'part')} removed")
        return
    usage, last = store.usage(), store.last_run
    detectors: list[dict[str, Any]] = [
        {"name": group.rpartition(".")[0], "parts": count, "bytes": size}
        for group, (count, size) in sorted(usage.items(), key=lambda item: (-item[1][0], item[0]))
    ]
    found, kept = last.get("found"), last.get("kept")
    size, parts = sum(size for _, size in usage.values()), sum(count for count, _ in usage.values())
    last_run = {"found": found, "kept": kept} if isinstance(found, int) and isinstance(kept, int) else None
    if as_json:
        about = {"folder": str(store.folder), "max_mb": store.max_mb, "bytes": size, "parts": parts}
        opt.say(json.dumps({**about, "detectors": detectors, "last_run": last_run}, indent=2))
        return
    rows = [
        ("folder", str(store.folder)),
        ("size", f"{size / 1024**2:.1f} of at most {store.max_mb} MB"),
        ("parts of logs", str(parts)),
        *(("", f"{d['parts']} by {d['name']}, {d['bytes'] / 1024**2:.1f} MB") for d in detectors),
    ]
    if last_run is not None:
        rows.append(("last run", f"{opt.counted(last_run['found'], 'tick')} known, {last_run['kept']} kept"))
    opt.say("\n".join(opt.format_rows(rows)))


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
        raise ConfigError(
            f"no page '{topic}'{nearest(topic, list(known))}; log2sim help lists them, log2sim COMMAND --help the options of a command"
        )
    text = re.sub(r"^!\[.*\n\n?", "", known[topic].rstrip(), flags=re.MULTILINE)
    opt.say(re.sub(r"\[([^\]]+)\]\([^)\s]+\)", r"\1", text))
