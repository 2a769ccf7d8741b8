"""Write the JSON Schemas that are generated from models: schemas/config-1.json and schemas/scene-1.json."""

from __future__ import annotations

import json
from pathlib import Path

from log2sim.config import Config
from log2sim.synth.scene import scene_schema

SCHEMAS = Path(__file__).resolve().parent.parent / "schemas"


def main() -> None:
    """Write every generated schema."""
    for name, schema in {"config-1": Config.model_json_schema(), "scene-1": scene_schema()}.items():
        (SCHEMAS / f"{name}.json").write_text(json.dumps(schema, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
