"""Write the JSON Schemas that are generated from models: schemas/config-1.json and schemas/scene-1.json."""

import json
from pathlib import Path

from log2sim.config import Config
from log2sim.synth.scene import Scene

SCENE = {
    "$schema": "https://json-schema.org/draft/2020-12/schema",
    **Scene.model_json_schema(),
    "title": "log2sim scene file, version 1",
}

if __name__ == "__main__":
    for name, schema in {"config-1": Config.model_json_schema(), "scene-1": SCENE}.items():
        path = Path(__file__).resolve().parents[1] / f"schemas/{name}.json"
        path.write_text(json.dumps(schema, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
