"""The rows of a batch as one page of HTML that loads nothing."""

from __future__ import annotations

import base64
import hashlib
import html
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from importlib import resources
from pathlib import Path

from log2sim.batch.folder import BatchSettings
from log2sim.batch.rows import Row
from log2sim.batch.table import sum_up
from log2sim.documents import replaced

MAX_ROWS = 5000
"""Of each table, which browsers lay out in a second; the Parquet file has all."""
COLUMNS = (
    ("log", "log", ""),
    ("format", "format", ""),
    ("ticks", "ticks", "d"),
    ("duration_s", "duration s", ".1f"),
    ("agents", "agents", "d"),
    ("static", "static", "d"),
    ("doubtful", "doubtful", "d"),
    ("faults", "faults", "d"),
    ("unreadable", "unreadable", "d"),
    ("seconds", "seconds", ".2f"),
    ("cpu_s", "CPU s", ".2f"),
    ("peak_memory_mib", "peak MiB", ".0f"),
    ("attempts", "attempts", "d"),
)


def write_batch_page(path: Path, rows: Sequence[Row], settings: BatchSettings, *, total: int) -> None:
    """Write the page of a batch: sums, what failed and why, and the figures of each log.

    Parameters
    ----------
    path : Path
    rows : sequence of Row
    settings : BatchSettings
    total : int
        Logs of the batch; those without a row were not run yet.
    """
    with replaced(path) as temporary:
        temporary.write_text(html_of(rows, settings, total), encoding="utf-8")


def html_of(rows: Sequence[Row], settings: BatchSettings, total: int) -> str:
    """Assemble the page; its content security policy allows its own script and style by their hashes and nothing else."""
    style, script = (_file(name) for name in ("page.css", "page.js"))
    failed, done = ([row for row in rows if row.is_done == wanted] for wanted in (False, True))
    parts = {
        "policy": f"default-src 'none'; script-src '{_hash(script)}'; style-src '{_hash(style)}'; img-src data:; "
        "base-uri 'none'; form-action 'none'",
        "style": style,
        "script": script,
        "root": html.escape(settings.root),
        "version": html.escape(settings.log2sim_version),
        "summary": "".join(_figures(rows, total)),
        "failures": _failures(failed),
        "logs": _logs(done),
    }
    # One pass: inserted text is not searched again, so no name of a log can be taken for a placeholder.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], _file("page.html"))


def _figures(rows: Sequence[Row], total: int) -> Iterable[str]:
    """Yield the sums as entries of a list of descriptions."""
    sums = sum_up(rows)
    agents = f"{sums['agents']:,.0f} ({sums['static']:,.0f} static, {sums['doubtful']:,.0f} doubtful)"
    figures = {
        "logs": f"{total:,}",
        "done": f"{sums['done']:,.0f}",
        "failed": f"{sums['failed']:,.0f}",
        "not run yet": f"{total - len(rows):,}" if total > len(rows) else "",
        "agents": agents,
        "recorded": f"{sums['duration_s'] / 3600:,.2f} h, {sums['ticks']:,.0f} ticks",
        "CPU time": f"{sums['cpu_s'] / 3600:,.2f} h",
    }
    for name, value in figures.items():
        if value:
            mark = ' class="alert"' if name == "failed" and sums["failed"] else ""
            yield f"<div{mark}><dt>{name}</dt><dd>{value}</dd></div>"


def _failures(rows: Sequence[Row]) -> str:
    """Return the section of the logs that failed, with a count of each kind of error; empty without any."""
    if not rows:
        return ""
    kinds = ", ".join(
        f"{count} {html.escape(kind)}" for kind, count in Counter(r.error_kind for r in rows).most_common()
    )
    lines = [
        f"<tr><td>{_linked(row)}</td><td>{html.escape(row.format)}</td><td>{html.escape(row.error_kind)}</td>"
        f"<td class=error>{html.escape(row.error)}</td><td class=n>{row.attempts}</td></tr>"
        for row in rows[:MAX_ROWS]
    ]
    head = "".join(f"<th>{title}</th>" for title in ("log", "format", "error", "message", "attempts"))
    return _section("Failed", f"{len(rows):,}: {kinds}", head, lines, len(rows))


def _logs(rows: Sequence[Row]) -> str:
    """Return the section of the logs that are done."""
    head = "".join(f"<th{' class=n' if form else ''}>{title}</th>" for _, title, form in COLUMNS)
    lines = [f"<tr>{''.join(_cell(row, name, form) for name, _, form in COLUMNS)}</tr>" for row in rows[:MAX_ROWS]]
    return _section("Logs", f"{len(rows):,} done", head, lines, len(rows)) if rows else ""


def _section(title: str, note: str, head: str, lines: Sequence[str], count: int) -> str:
    left_out = f"<p>The first {MAX_ROWS:,} of {count:,}; table.parquet has all.</p>" if count > MAX_ROWS else ""
    body = "\n".join(lines)
    return (
        f"<section><h2>{title} <small>{note}</small></h2>{left_out}<div class=scroll><table><thead><tr>{head}</tr></thead>"
        f"<tbody>\n{body}\n</tbody></table></div></section>"
    )


def _cell(row: Row, name: str, form: str) -> str:
    value = getattr(row, name)
    if name == "log":
        return f"<td>{_linked(row)}</td>"
    if not form:
        return f"<td>{html.escape(value)}</td>"
    return f'<td class=n data-v="{value}">{value:{form}}</td>' if value is not None else "<td class=n>-</td>"


def _linked(row: Row) -> str:
    """Return the name of a log as a link to its folder beside the page."""
    return f'<a href="logs/{html.escape(row.name)}/">{html.escape(row.log)}</a>'


def _hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _file(name: str) -> str:
    return resources.files("log2sim.batch").joinpath(name).read_text(encoding="utf-8")
