"""Puts data, script and style into one HTML file."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from log2sim.datatypes import Log, Scenario
from log2sim.errors import ConfigError
from log2sim.files.documents import refuse_existing, replaced
from log2sim.localization.choice import localize_like
from log2sim.road.ground_map import GroundMap
from log2sim.visualization.page.document import page_document
from log2sim.visualization.recording import Recorded, recording_document

SUFFIXES = (".html", ".htm")
MARGIN_BYTES = 10_000  # of a page, for the names and keys around pictures and points
# Parts of the script in the order of their dependencies.
SCRIPT_FILES = (
    "track.js", "features.js", "background.js", "predicted.js", "decoded.js", "theme.js", "ends.js", "warnings.js", "map.js",
    "scale.js", "points.js", "paint.js", "chart.js", "list.js", "details.js", "controls.js", "state.js", "outlines.js",
    "pictures.js", "collisions.js", "timeline.js", "lists.js", "main.js", "surface.js", "studio.js", "scripting.js",
)  # fmt: skip


def check_name(path: Path) -> None:
    """Raise `ConfigError` for a name that is none of a page."""
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"{path}: a page's name must end in {' or '.join(SUFFIXES)}, not in '{path.suffix}'")


def write_page(
    scenario: Scenario,
    out_path: Path | str,
    *,
    truth: Scenario | None = None,
    replay: Any = None,
    predict_s: float | None = None,
    background: GroundMap | None = None,
    recorded: Recorded | Log | None = None,
    metrics: Sequence[tuple[str, str]] = (),
    overwrite: bool = False,
) -> tuple[str, ...]:
    """Write a self-contained page that plays a scenario in a browser and loads nothing over the network.

    Raises `ConfigError` when the name ends in something else than .html, the file exists and `overwrite` is False, it
    cannot be written, or there are more waypoints than a page can hold, for a horizon that predictions do not have, or
    when the size is too small for what is to be shown. Raises `LogError` when no record of the log can be read.

    `truth`: shown as a layer, aligned to the scenario's time and map. `replay`: shown as a layer, and beside the scenario in the
    plots of an agent. `predict_s`, s: for how long it is shown where agents were expected to go. `background`: map of the ground to
    show below everything; the page holds a copy of at most some megabytes. `recorded`: log whose pictures and LiDAR points are shown,
    and the size of the page that they have to fit into. `metrics`: titles and texts, such as tables of `evaluate`; those of the
    replay are shown too. Returns what was taken of the log, in sentences; empty without one.
    """
    out_path = Path(out_path)
    check_name(out_path)
    refuse_existing(out_path, overwrite=overwrite)
    if isinstance(recorded, Log):
        recorded = Recorded(localize_like(recorded, scenario.provenance))
    shown: dict[str, Any] = {"truth": truth, "replay": replay, "background": background, "metrics": metrics}
    document = page_document(scenario, predict_s=predict_s, **shown)
    page = make_page(document, scenario, recorded)
    with replaced(out_path) as temporary:
        temporary.write_bytes(page)
    return tuple(document["recording"]["notes"]) if recorded is not None else ()


def make_page(document: dict[str, Any], scenario: Scenario, recorded: Recorded | None) -> bytes:
    """Return the page of a document, to which `recorded` adds what fits of pictures and points of a log.

    Raises `ConfigError` when nothing fits.
    """
    if recorded is not None:
        rest = len(page_html(document).encode()) + MARGIN_BYTES
        if rest >= recorded.max_bytes:
            raise ConfigError(f"--max-mb: the page has {rest / 1e6:.2f} MB without any picture; give more than that")
        document["recording"] = recording_document(scenario, recorded, recorded.max_bytes - rest)
    page = page_html(document).encode()
    if recorded is not None and len(page) > recorded.max_bytes:
        raise ConfigError(f"--max-mb: the page has {len(page) / 1e6:.2f} MB at least; give as much")
    return page


def page_html(document: dict[str, Any]) -> str:
    """Assemble the page; its content security policy allows this script and style by their hashes and nothing else.

    Only a page that has an address of the studio talks to anybody: the program that serves it.
    """
    script = '"use strict";\n(() => {\n' + "".join(_file(name) for name in SCRIPT_FILES) + "})();\n"
    style = _file("style.css")
    policy = (
        f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    ) + ("; connect-src 'self'" if "address" in document["studio"] else "")
    text = json.dumps(document, separators=(",", ":"), allow_nan=False)
    parts = {
        "policy": policy, "title": html.escape(document["name"] or "scenario"), "style": style,
        "data": text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"), "script": script,
    }  # fmt: skip
    # One pass: inserted text is not searched again, so no name in a scenario can be taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _file("page.html"))


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _file(name: str) -> str:
    return resources.files("log2sim.visualization.page").joinpath(name).read_text(encoding="utf-8")
