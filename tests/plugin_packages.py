"""Packages with plug-ins as pip would have installed them: a module, and a .dist-info folder with its entry points."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "samples/cookbook/plugins.md").read_text(encoding="utf-8")


def install(folder: Path, name: str, code: str, entries: dict[str, dict[str, str]], version: str = "1.0") -> None:
    """Lay a package into a folder of the search path: `entries` are places by entry-point group and name."""
    module = name.replace("-", "_")
    (folder / f"{module}.py").write_text(code, encoding="utf-8")
    about = folder / f"{module}-{version}.dist-info"
    about.mkdir()
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in named.items()) for group, named in entries.items()]
    (about / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")


def install_examples(folder: Path) -> None:
    """Lay the package of the cookbook's page "plugins" into a folder, with all of its examples."""
    (project,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    about = tomllib.loads(project)["project"]
    code = "\n\n".join(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL))
    install(folder, about["name"], code, about["entry-points"], about["version"])
