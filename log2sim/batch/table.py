"""The rows of a batch as a table of Parquet, and what they sum up to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import UnionType
from typing import Any, get_args

from log2sim.batch.rows import Row
from log2sim.documents import replaced

SUMMED = ("ticks", "duration_s", "agents", "static", "doubtful", "faults", "unreadable", "seconds", "cpu_s")


def write_parquet(path: Path, rows: Sequence[Row]) -> None:
    """Write the rows, one for each log, with the columns of `Row`."""
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {int: pa.int64(), float: pa.float64(), str: pa.string()}
    fields = [(name, kinds[_plain_type(field.annotation)]) for name, field in Row.model_fields.items()]
    values = {name: [getattr(row, name) for row in rows] for name, _ in fields}
    table = pa.table(values, schema=pa.schema(fields))
    with replaced(path) as temporary:
        parquet.write_table(table, temporary)


def _plain_type(annotation: Any) -> type:
    """Return the type of the values of a field, where it may be absent or is one of several texts."""
    parts = get_args(annotation) if isinstance(annotation, UnionType) else (annotation,)
    return next((kind for kind in (int, float) if kind in parts), str)


def sum_up(rows: Sequence[Row]) -> dict[str, float]:
    """Return the count of logs that are done and that failed, and the sums of the figures of those that are done."""
    done = [row for row in rows if row.is_done]
    sums = {name: sum(getattr(row, name) or 0 for row in done) for name in SUMMED}
    return {"done": len(done), "failed": len(rows) - len(done), **sums}
