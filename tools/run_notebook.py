"""Run the cells of a notebook in this process, in order, and keep what they show as its outputs.

    python tools/run_notebook.py samples/first_steps.ipynb

Without a kernel: nbclient would bring one with ZeroMQ and a dozen packages. Pictures are kept as JPEG, which is a tenth of the size.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import matplotlib.pyplot as plt
import numpy as np

MAX_WIDTH_PX, JPEG_QUALITY = 900, 75


def run_cell(source: str, names: dict[str, Any]) -> Any:
    """Run the code of a cell and return the value of its last line, None where that is no expression."""
    tree = ast.parse(source)
    last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "cell", "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), "cell", "eval"), names)


def shown(value: Any) -> dict[str, Any]:
    """Return what a notebook keeps of a value: the first representation that there is, as media type and data."""
    text = {"text/plain": lines_of(repr(value))}
    png = getattr(value, "_repr_png_", lambda: None)()
    if png is not None:
        return {"image/jpeg": as_jpeg(png), **text}
    page = getattr(value, "_repr_html_", lambda: None)()
    return text if page is None else {"text/html": lines_of(page), **text}


def as_jpeg(png: bytes) -> str:
    """Return a picture as a JPEG of limited width, in base64."""
    image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    scale = min(1.0, MAX_WIDTH_PX / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return base64.b64encode(cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]).decode("ascii")


def lines_of(text: str) -> list[str]:
    """Return text as the lines of a notebook; of a line that was written anew, the last state."""
    last = re.sub(r"[^\n]*\r", "", text)
    return re.sub(r" +$", "", last, flags=re.MULTILINE).splitlines(keepends=True)


def run(cells: list[dict[str, Any]]) -> None:
    """Run the cells and replace their outputs."""
    plt.switch_backend("agg")
    names: dict[str, Any] = {"__name__": "__main__"}
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    for count, cell in enumerate(code, start=1):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            value = run_cell("".join(cell["source"]), names)
        outputs: list[dict[str, Any]] = []
        if printed.getvalue():
            text = lines_of(printed.getvalue())
            outputs.append({"name": "stdout", "output_type": "stream", "text": text})
        if value is not None:
            outputs.append(
                {"data": shown(value), "execution_count": count, "metadata": {}, "output_type": "execute_result"}
            )
        for number in plt.get_fignums():
            data = io.BytesIO()
            plt.figure(number).savefig(data, format="png", bbox_inches="tight")
            plt.close(number)
            picture = {"image/jpeg": as_jpeg(data.getvalue()), "text/plain": ["<Figure>"]}
            outputs.append({"data": picture, "metadata": {}, "output_type": "display_data"})
        cell["execution_count"], cell["outputs"] = count, outputs


def main() -> None:
    """Run the notebook that the command line names, in its folder."""
    path = Path(sys.argv[1]).resolve()
    notebook = json.loads(path.read_text(encoding="utf-8"))
    os.chdir(path.parent)
    run(notebook["cells"])
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
