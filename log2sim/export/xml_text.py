"""XML as formats of simulators need it: numbers in a fixed form, escaped text, safe parsing."""

from __future__ import annotations

import io
import re
import string
from collections.abc import Iterable
from pathlib import Path
from urllib.parse import quote, unquote
from xml.etree import ElementTree

from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import iterparse

from log2sim.errors import LogError, ScenarioError
from log2sim.files.documents import parse_float
from log2sim.files.inputs import read_file

SIZE_LIMIT_BYTES = 256 * 1024 * 1024
DEPTH_LIMIT = 100
# "$" begins a parameter in OpenSCENARIO, "%" our own escape; all other printable ASCII is unchanged.
_PLAIN = "".join(c for c in string.printable if c not in "%$" and (c == " " or not c.isspace()))


def element(tag: str, parent: ElementTree.Element | None = None, **attributes: str) -> ElementTree.Element:
    """Create an element, within `parent` unless that is None."""
    if parent is None:
        return ElementTree.Element(tag, attributes)
    return ElementTree.SubElement(parent, tag, attributes)


def number(value: float, digits: int = 6) -> str:
    """Format a finite number with a limited number of decimals, without exponent, and never as "-0"."""
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text


def escaped(text: str) -> str:
    """Encode any text as printable ASCII that no player takes for a parameter; `unescaped` is the inverse."""
    return quote(text, safe=_PLAIN, errors="replace")


def unescaped(text: str) -> str:
    """Decode the text given to `escaped`, except for halves of surrogate pairs, which no file can hold."""
    return unquote(text, errors="replace")


def unique_names(texts: Iterable[str]) -> list[str]:
    """Make names of letters, digits, "_", "-" and ".", one for each text, unique also when case is ignored."""
    names: list[str] = []
    taken: set[str] = set()
    for text in texts:
        stem = re.sub(r"[^A-Za-z0-9_.-]", "_", text)[:60] or "_"
        name, k = stem, 1
        while name.lower() in taken:
            k += 1
            name = f"{stem}_{k}"
        taken.add(name.lower())
        names.append(name)
    return names


def write(root: ElementTree.Element, path: Path) -> None:
    """Write a document, indented, in UTF-8."""
    ElementTree.indent(root, space=" ")
    text = ElementTree.tostring(root, encoding="unicode")
    path.write_text(f'<?xml version="1.0" encoding="UTF-8"?>\n{text}\n', encoding="utf-8", newline="\n")


def read(path: Path) -> ElementTree.Element:
    """Parse a file of at most `SIZE_LIMIT_BYTES` without entities, DTDs or anything outside it.

    Raises `ScenarioError` when the file is missing, too large, nested too deeply or no XML, or declares a document
    type.
    """
    data = read_file(path, SIZE_LIMIT_BYTES, ScenarioError, missing="no such file; expected an XML file")
    depth, root = 0, None
    try:
        for event, node in iterparse(io.BytesIO(data), events=("start", "end"), forbid_dtd=True):
            depth += 1 if event == "start" else -1
            root = node if root is None else root
            if depth > DEPTH_LIMIT:
                raise ScenarioError(
                    f"{path}: elements nest deeper than {DEPTH_LIMIT}; is this a scenario or road file?"
                )
    except DefusedXmlException:
        raise ScenarioError(
            f"{path}: has a document type declaration, which is not read; remove its <!DOCTYPE ...>"
        ) from None
    except (ElementTree.ParseError, LookupError, ValueError) as problem:  # LookupError: unknown encoding
        raise ScenarioError(f"{path}: not valid XML: {problem}") from None
    if root is None:
        raise ScenarioError(f"{path}: not valid XML: no element found")
    result: ElementTree.Element = root
    return result


def require_number(value: str | None, where: str) -> float:
    """Parse a finite number from an attribute.

    Raises `LogError` when the attribute is absent or no finite number.
    """
    try:
        found = parse_float(value) if value is not None else float("nan")
    except ValueError:
        found = float("nan")
    if not -1e300 < found < 1e300:
        raise LogError(f"{where} is {str(value)[:40]!r}, expected a finite number")
    return found
