"""What is installed, what is missing, and whether it works."""

from __future__ import annotations

import importlib
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import InvalidRequirement, Requirement

from log2sim.cli.options import AsJson, fail, say
from log2sim.errors import Log2SimError, install_command
from log2sim.version import __version__

OK, MISSING, OUTDATED, BROKEN = "ok", "missing", "outdated", "broken"
MIN_PYTHON = (3, 11)

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


@dataclass(frozen=True)
class Package:
    """A package that log2sim needs."""

    name: str
    version: str | None  # none where it is missing
    state: str  # {"ok", "missing", "outdated", "broken"}, broken: it is there and cannot be imported
    problem: str = ""  # what is wrong, for people; empty without a problem


@dataclass(frozen=True)
class Extra:
    """An optional part of log2sim."""

    name: str
    missing: tuple[str, ...]  # packages of it that are missing or too old
    purpose: str  # empty for extras that are for development
    install: str  # A line for the shell that adds it


@dataclass(frozen=True)
class Installation:
    """What `log2sim doctor` shows."""

    # log2sim, python, system: versions; the system with its processor.
    log2sim: str
    python: str
    system: str
    program: str  # the Python that runs
    packages: tuple[Package, ...]  # those that are needed
    extras: tuple[Extra, ...]
    models: dict[str, str]  # by detector: "ready", or what it needs
    cache: str  # folder of the cache
    cache_bytes: int  # size of what is in it
    # cores, usable_cores: processors of the machine, and those that this process may use.
    cores: int
    usable_cores: int
    threads: dict[str, str]  # variables of the environment that limit threads
    browser: str | None  # A browser that shows the pages of `log2sim view`
    broken: tuple[str, ...]  # what is needed and does not work, each with what to do

    def to_dict(self) -> dict[str, Any]:
        """Return it as a JSON document."""
        return asdict(self)


def examine() -> Installation:
    """Look at everything; imports all packages that log2sim needs."""
    requirements = read_requirements()
    packages = tuple(examine_package(r) for r in requirements if not r.marker or "extra" not in str(r.marker))
    cache = find_cache()
    models, unusable = find_models()
    # Add up the sizes of the files in a folder, bytes; 0 without it.
    total = 0
    for place, _, files in os.walk(cache):
        for file in files:
            try:
                total += os.lstat(os.path.join(place, file)).st_size
            except OSError:  # gone in the meantime
                continue
    return Installation(
        log2sim=__version__,
        python=platform.python_version(),
        system=f"{platform.system()} {platform.release()} {platform.machine()}",
        program=sys.executable,
        packages=packages,
        extras=tuple(examine_extras(requirements)),
        models=models,
        cache=str(cache),
        cache_bytes=total,
        cores=os.cpu_count() or 1,
        usable_cores=count_usable_cores(),
        threads={name: os.environ[name] for name in THREAD_VARIABLES if os.environ.get(name)},
        browser=next((found for name in BROWSERS if (found := shutil.which(name))), None),
        broken=(*find_python_problem(), *(f"{p.name}: {p.problem}" for p in packages if p.problem), *unusable),
    )


def read_requirements() -> list[Requirement]:
    """Read what log2sim requires: from the checkout it runs from, else from the installed package."""
    project = Path(__file__).resolve().parents[2] / "pyproject.toml"
    if project.is_file():
        import tomllib

        table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
        lines = list(table["dependencies"])
        for extra, wanted in table["optional-dependencies"].items():
            lines += [_requirement_of_extra(line, extra) for line in wanted]
    else:
        lines = metadata.requires("log2sim") or []
    found = []
    for line in lines:
        try:
            found.append(Requirement(line))
        except InvalidRequirement:
            continue
    return found


def _requirement_of_extra(line: str, extra: str) -> str:
    """Return a requirement of an extra as the metadata of packages state it."""
    package, _, marker = line.partition(";")
    condition = f"({marker.strip()}) and " if marker else ""
    return f"{package.strip()}; {condition}extra == '{extra}'"


def examine_package(requirement: Requirement) -> Package:
    """Import a package that is needed, and compare its version with what is required."""
    name = MODULES.get(requirement.name, requirement.name.replace("-", "_"))
    version = version_of(requirement.name)
    try:
        module = importlib.import_module(name)
    except Exception as error:  # whatever a broken package raises
        if version is None:
            return Package(
                requirement.name, None, MISSING, f"is missing: pip install '{requirement.name}{requirement.specifier}'"
            )
        return Package(requirement.name, version, BROKEN, f"cannot be imported: {type(error).__name__}: {error}")
    version = version or str(getattr(module, "__version__", "")) or None  # the module of another distribution
    if version is not None and not requirement.specifier.contains(version, prereleases=True):
        wanted = f"{requirement.name}{requirement.specifier}"
        return Package(requirement.name, version, OUTDATED, f"{version} is too old: pip install '{wanted}'")
    return Package(requirement.name, version, OK)


def examine_extras(requirements: list[Requirement]) -> Iterator[Extra]:
    """Yield each extra with those of its packages that are missing, those for users first."""
    names = dict.fromkeys(extra for r in requirements if (extra := extra_of(r)))
    for extra in sorted(names, key=lambda name: (name not in PURPOSES, name)):
        needed = [r for r in requirements if r.marker and extra_of(r) == extra and r.marker.evaluate({"extra": extra})]
        missing = tuple(r.name for r in needed if not is_module_installed(r))
        yield Extra(extra, missing, PURPOSES.get(extra, ""), install_command(extra))


def extra_of(requirement: Requirement) -> str | None:
    """Return the extra that a requirement belongs to; None for what is always needed."""
    marker = str(requirement.marker or "")
    _, found, after = marker.partition('extra == "')
    return after.split('"')[0] if found else None


def is_module_installed(requirement: Requirement) -> bool:
    """Return whether a package is there in a version that is good enough."""
    version = version_of(requirement.name)
    return version is not None and requirement.specifier.contains(version, prereleases=True)


def version_of(name: str) -> str | None:
    """Return the version of an installed package; None without it."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def find_python_problem() -> tuple[str, ...]:
    """Say where Python is too old; nothing elsewhere."""
    if sys.version_info >= MIN_PYTHON:
        return ()
    return (f"Python {platform.python_version()} is too old: log2sim needs {'.'.join(map(str, MIN_PYTHON))}",)


def find_models() -> tuple[dict[str, str], tuple[str, ...]]:
    """Return the built-in detectors with what they need, and what should be there and is not."""
    folder = Path(__file__).resolve().parents[1] / "perception" / "detect3d" / "weights"
    models, broken = {}, []
    for name in ("vehicle", "roadside"):
        model = folder / f"{name}.onnx"
        models[f"lidar:{name}"] = "ready" if model.is_file() else f"{model} is missing"
        if not model.is_file():
            broken.append(f"{model}: is missing; install log2sim again")
    try:
        models["ssd-mobilenet-v2"] = _state_of_image_detector()
    except (Log2SimError, ImportError) as error:
        models["ssd-mobilenet-v2"] = str(error)
    return models, tuple(broken)


def _state_of_image_detector() -> str:
    from log2sim.perception.detect.ssd_mobilenet import NAME, graph_bytes

    if any(find_cache().glob(f"{NAME}-*.onnx")):
        return "ready"
    graph_bytes()
    return "ready; converted into the cache at its first use"


def find_cache() -> Path:
    """Return the folder of the cache."""
    from log2sim.files.cache import cache_folder

    return cache_folder()


def count_usable_cores() -> int:
    """Count the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


BROKEN_CODE = 5  # as where an extra is missing: something has to be installed


def doctor(as_json: AsJson = False) -> None:
    """Show versions, extras, models, cache and processors, and what is missing with the line that installs it.

    Exits with 0, or with 5 when something is broken that every command needs; a missing extra is not.

    Examples
    --------
    log2sim doctor
    log2sim doctor --json
    """
    import json

    found = examine()
    say(json.dumps(found.to_dict(), indent=2) if as_json else "\n".join(describe_installation(found)))
    if found.broken:
        fail("; ".join(found.broken), BROKEN_CODE)


def describe_installation(found: Installation) -> list[str]:
    """Describe an installation in lines for people."""
    from log2sim.cli.shared import format_rows

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
