"""Checks a document by the schema of OpenLABEL 1.0.0, as Vicomtech's VCD has it; complaints as JSON.

Runs in an environment of its own: `python openlabel_check.py FILE.json`.
"""

from __future__ import annotations

import json
import sys

import jsonschema
from vcd.schema import openlabel_schema


def main() -> None:
    with open(sys.argv[1], encoding="utf-8") as file:
        document = json.load(file)
    found = jsonschema.Draft7Validator(openlabel_schema).iter_errors(document)
    sys.stdout.write(json.dumps({"complaints": [f"{list(e.absolute_path)}: {e.message[:200]}" for e in found]}))


if __name__ == "__main__":
    main()
