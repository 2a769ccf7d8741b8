"""Show, limit and clear the cache of first passes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from log2sim.files.cache import DiskCache


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove all that is kept.")] = False,
    max_mb: Annotated[
        int | None,
        typer.Option(
            "--max-mb",
            metavar="MB",
            min=0,
            max=2**30,
            help="Size of the cache from now on, for all runs; what was not used for longest is dropped. At first 2048.",
            show_default="as it is",
        ),
    ] = None,
    as_json: opt.AsJson = False,
) -> None:
    """Show what is kept of earlier runs, so that nothing is detected and measured twice; limit it or remove it.

    The environment variable LOG2SIM_CACHE moves the folder.

    Examples
    --------
    log2sim cache
    log2sim cache --max-mb 8192
    """
    import json

    from log2sim.files.cache import DiskCache, detection_folder

    store = DiskCache(detection_folder())
    if max_mb is not None:
        store.set_limit(max_mb)
    removed = store.clear() if clear else None
    if as_json:
        opt.say(json.dumps(summarize_cache(store), indent=2))
    elif removed is not None:
        opt.say(f"{store.folder}: {opt.counted(removed, 'part')} removed")
    else:
        opt.say("\n".join(describe_cache(summarize_cache(store))))


def summarize_cache(store: DiskCache) -> dict[str, Any]:
    """Return the folder and the size of a cache, the parts of logs by detector, and what the last run took from it."""
    usage, last = store.usage(), store.last_run
    detectors = [
        {"name": group.rpartition(".")[0], "parts": count, "bytes": usage.bytes[group]}
        for group, count in sorted(usage.entries.items(), key=lambda item: (-item[1], item[0]))
    ]
    found, kept = last.get("found"), last.get("kept")
    return {
        "folder": str(store.folder),
        "max_mb": store.max_mb,
        "bytes": sum(usage.bytes.values()),
        "parts": sum(usage.entries.values()),
        "detectors": detectors,
        "last_run": {"found": found, "kept": kept} if isinstance(found, int) and isinstance(kept, int) else None,
    }


def describe_cache(found: dict[str, Any]) -> list[str]:
    """Describe a cache in lines for people."""
    from log2sim.cli.shared import format_rows

    rows = [
        ("folder", found["folder"]),
        ("size", f"{_megabytes(found)} of at most {found['max_mb']} MB"),
        ("parts of logs", str(found["parts"])),
        *(("", f"{d['parts']} by {d['name']}, {_megabytes(d)} MB") for d in found["detectors"]),
    ]
    last = found["last_run"]
    if last is not None:
        rows.append(("last run", f"{opt.counted(last['found'], 'tick')} known, {last['kept']} kept"))
    return list(format_rows(rows))


def _megabytes(entry: dict[str, Any]) -> str:
    return f"{entry['bytes'] / 1024**2:.1f}"
