"""Writes the cookbook's table of export formats, what each understands and what it loses, between its markers."""

from __future__ import annotations

from pathlib import Path

from log2sim.files import plugins

PAGE = Path(__file__).resolve().parents[1] / "samples/cookbook/exports.md"
BEGIN, END = "<!-- formats: begin -->\n", "<!-- formats: end -->\n"


def table() -> str:
    """A row for every built-in format, in the order of the registry."""
    rows = ["| `--to` | options | what it cannot hold |", "|---|---|---|"]
    for name in plugins.BUILT_IN["export"]:
        exporter = plugins.load("export", name)
        options = ", ".join(f"`--{option}`" for option in exporter.options)
        rows.append(f"| `{name}` | {options} | {exporter.loses} |")
    return "\n".join(rows) + "\n"


def with_table(text: str) -> str:
    """The page with the table of today."""
    begin, end = text.index(BEGIN) + len(BEGIN), text.index(END)
    return text[:begin] + table() + text[end:]


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
