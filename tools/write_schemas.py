"""Write the JSON Schemas that are generated from models: schemas/scene-1.json."""

from __future__ import annotations

import json
from pathlib import Path

from log2sim.synth.scene import scene_schema

SCHEMAS = Path(__file__).resolve().parent.parent / "schemas"


def main() -> None:
    """Write every generated schema."""
    for name, schema in {"scene-1": scene_schema()}.items():
        (SCHEMAS / f"{name}.json").write_text(json.dumps(schema, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
