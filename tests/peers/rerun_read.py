"""Reads a Rerun recording with Rerun's own reader and prints every row of some entities as JSON.

Runs in an environment of its own: `python rerun_read.py FILE.rrd PREFIX`, for entities whose path begins so.
"""

from __future__ import annotations

import json
import sys

import pyarrow
from rerun.chunk import RrdReader


def rows(chunk):
    """Each row as entity, stamp in ns or None, and its values by column."""
    batch = chunk.to_record_batch()
    kinds = {field.name: (field.metadata or {}).get(b"rerun:kind") for field in batch.schema}
    times = [name for name, kind in kinds.items() if kind == b"index" and name == "time"]
    stamps = batch.column(times[0]).cast(pyarrow.int64()).to_pylist() if times else [None] * batch.num_rows
    # Pictures are for viewers; their length tells enough.
    plain = {
        name: ["<blob>"] * batch.num_rows if "blob" in name else batch.column(name).to_pylist()
        for name, kind in kinds.items()
        if kind == b"data"
    }
    for k, stamp in enumerate(stamps):
        yield chunk.entity_path, stamp, {name: values[k] for name, values in plain.items() if values[k] is not None}


def main(file, prefix):
    chunks = [c for c in RrdReader(file).stream().to_chunks() if c.entity_path.startswith(prefix)]
    json.dump([row for chunk in chunks for row in rows(chunk)], sys.stdout)


main(*sys.argv[1:])
