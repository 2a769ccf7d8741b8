"""Show, limit and clear the cache of first passes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from log2sim.cli import options as opt
from log2sim.cli.shared import format_rows

if TYPE_CHECKING:
    from log2sim.files.cache import DiskCache


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
        {"name": group.rpartition(".")[0], "parts": count, "bytes": size}
        for group, (count, size) in sorted(usage.items(), key=lambda item: (-item[1][0], item[0]))
    ]
    found, kept = last.get("found"), last.get("kept")
    return {
        "folder": str(store.folder), "max_mb": store.max_mb, "bytes": sum(size for _, size in usage.values()),
        "parts": sum(count for count, _ in usage.values()), "detectors": detectors,
        "last_run": {"found": found, "kept": kept} if isinstance(found, int) and isinstance(kept, int) else None,
    }  # fmt: skip


def describe_cache(found: dict[str, Any]) -> list[str]:
    """Describe a cache in lines for people."""
    sizes = [f"{entry['bytes'] / 1024**2:.1f}" for entry in (found, *found["detectors"])]
    rows = [
        ("folder", found["folder"]),
        ("size", f"{sizes[0]} of at most {found['max_mb']} MB"),
        ("parts of logs", str(found["parts"])),
        *(("", f"{d['parts']} by {d['name']}, {size} MB") for d, size in zip(found["detectors"], sizes[1:])),
    ]
    last = found["last_run"]
    if last is not None:
        rows.append(("last run", f"{opt.counted(last['found'], 'tick')} known, {last['kept']} kept"))
    return format_rows(rows)
