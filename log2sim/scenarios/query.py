"""Conditions on tags: parsed as Python expressions of a few kinds, asked of DuckDB with all values as parameters.

DuckDB, since a question such as "a cut-in during which the ego brakes hard" joins tags by overlapping times, which datasets of
pyarrow cannot; it runs within this process, needs no server, and reads tables of Arrow without a copy.
"""

from __future__ import annotations

import ast
import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from log2sim.datatypes import TAGS
from log2sim.errors import ConfigError, MissingExtra
from log2sim.files.plugins import nearest
from log2sim.scenarios.index import ROLES, TEXTS, Index, Row

MAX_LETTERS, MAX_NODES = 2000, 200

COMPARISONS = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "=", ast.NotEq: "<>"}
ARITHMETIC = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}

# Tags of the same scenario that share a road user and a time.
JOIN = """LEFT JOIN tags AS {j} ON {j}.file = e.file AND {j}.tag = ? AND {j}.start_s <= e.end_s AND {j}.end_s >= e.start_s
 AND ({j}.agent IN (e.agent, e.other) OR {j}.other IN (e.agent, e.other))"""


@dataclass(frozen=True)
class Found:
    """What came of a query."""

    rows: tuple[Row, ...]  # tags that fulfil the condition, the most probable first
    main: tuple[str, ...]  # the tags that the rows are of
    closest: tuple[str, ...] = ()  # where there are none: sentences that say what was closest


@dataclass
class _Sql:
    """Text of a condition and the values for its question marks, in their order."""

    text: str
    values: list[Any] = field(default_factory=list)
    kind: str = "truth"  # or "number", "text"


class Condition:
    """A condition on tags, checked against the columns of an index.

    Raises `ConfigError` for what is no expression of the language, and for names that are neither tags nor fields.
    """

    def __init__(self, text: str, columns: Sequence[str]) -> None:
        self.text, self.columns = text.strip(), list(columns)
        if not self.text or len(self.text) > MAX_LETTERS:
            raise ConfigError(
                f"condition: has {len(self.text)} letters, expected 1 to {MAX_LETTERS}, such as 'cut_in and ttc_s < 2'"
            )
        try:
            self.tree = ast.parse(self.text, mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as problem:
            raise ConfigError(
                f"condition '{self.text}': {problem.args[0]}; expected such as 'cut_in and ttc_s < 2'"
            ) from None
        if sum(1 for _ in ast.walk(self.tree)) > MAX_NODES:
            raise ConfigError(f"condition: has more than {MAX_NODES} parts; ask for less at once")
        self.parts = _conjuncts(self.tree)
        self.main = tuple(dict.fromkeys(_main_tags(self.tree)))
        self.joined: dict[str, str] = {}
        self.where(self.parts)  # so that what is wrong is said at once

    def where(self, parts: Sequence[ast.expr]) -> _Sql:
        """Return SQL for all of some parts, and for the tags that the rows are of."""
        whole = [self._truth(part) for part in parts]
        if self.main:
            whole.insert(0, _Sql(f"e.tag IN ({', '.join('?' * len(self.main))})", list(self.main)))
        return _Sql(" AND ".join(w.text for w in whole) or "TRUE", [v for w in whole for v in w.values])

    def _truth(self, node: ast.expr) -> _Sql:
        sql = self._sql(node)
        if sql.kind != "truth":
            raise self._wrong(node, f"is a {sql.kind}, expected a tag or a comparison, such as 'ttc_s < 2'")
        return sql

    def _sql(self, node: ast.expr) -> _Sql:
        match node:
            case ast.BoolOp(junction, operands):
                parts = [self._truth(v) for v in operands]
                word = " AND " if isinstance(junction, ast.And) else " OR "
                return _Sql(f"({word.join(p.text for p in parts)})", [v for p in parts for v in p.values])
            case ast.UnaryOp(ast.Not(), operand):
                part = self._truth(operand)
                return _Sql(f"NOT ({part.text})", part.values)
            case ast.UnaryOp(ast.USub(), operand):
                part = self._number(operand)
                return _Sql(f"(-{part.text})", part.values, "number")
            case ast.BinOp(one, op, two) if type(op) in ARITHMETIC:
                left, right = self._number(one), self._number(two)
                divisor = f"nullif({right.text}, 0)" if isinstance(op, ast.Div) else right.text
                return _Sql(f"({left.text} {ARITHMETIC[type(op)]} {divisor})", left.values + right.values, "number")
            case ast.Compare():
                return self._comparison(node)
            case ast.Call(ast.Name("abs"), [operand], []):
                part = self._number(operand)
                return _Sql(f"abs({part.text})", part.values, "number")
            case ast.Constant(value) if type(value) in (int, float, str):
                return _Sql("?", [value], "text" if isinstance(value, str) else "number")
            case ast.Name(name):
                return self._name(name)
            case ast.Attribute(ast.Name(of), name):
                return self._attribute(of, name)
        raise self._wrong(
            node,
            "is not understood; expected tags, fields, numbers and texts with and, or, not, < <= > >= == != in + - * /",
        )

    def _number(self, node: ast.expr) -> _Sql:
        part = self._sql(node)
        if part.kind != "number":
            raise self._wrong(node, f"is a {part.kind.replace('truth', 'tag or comparison')}, expected a number")
        return part

    def _comparison(self, node: ast.Compare) -> _Sql:
        texts, values, left = [], list[Any](), node.left
        for op, right in zip(node.ops, node.comparators):
            one = self._sql(left)
            if isinstance(op, (ast.In, ast.NotIn)) and isinstance(right, (ast.Tuple, ast.List)) and right.elts:
                others = [self._sql(e) for e in right.elts]
                marks = ", ".join(o.text for o in others)
                texts.append(f"{one.text} {'NOT ' * isinstance(op, ast.NotIn)}IN ({marks})")
            elif type(op) in COMPARISONS:
                others = [self._sql(right)]
                texts.append(f"{one.text} {COMPARISONS[type(op)]} {others[0].text}")
            else:
                raise self._wrong(
                    node, "compares in a way that is not understood; expected < <= > >= == != or in (A, B)"
                )
            if any(o.kind != one.kind or o.kind == "truth" for o in others):
                raise self._wrong(node, "compares a number with a text, or what is neither; texts need quotes")
            values += [*one.values, *(v for o in others for v in o.values)]
            left = right
        return _Sql(f"({' AND '.join(texts)})", values)

    def _name(self, name: str) -> _Sql:
        if name in TAGS:
            if name in self.main:
                return _Sql("(e.tag = ?)", [name])
            return _Sql(f"({self._alias(name)}.tag IS NOT NULL)")
        if name in self.columns and "." not in name:
            return _Sql(f'e."{name}"', kind="text" if name in TEXTS else "number")
        known = [*TAGS, *(c for c in self.columns if "." not in c), *ROLES]
        raise ConfigError(
            f"condition: '{name}' is neither a tag nor a field{nearest(name, known)}; log2sim find --help lists tags, `log2sim find FOLDER --fields` fields"
        )

    def _attribute(self, of: str, name: str) -> _Sql:
        if of in ROLES:
            known = [c.partition(".")[2] for c in self.columns if c.startswith(f"{of}.")]
            if name not in known:
                raise ConfigError(
                    f"condition: {of} has no field '{name}'{nearest(name, known)}; it has {', '.join(known)}"
                )
            return _Sql(f'e."{of}.{name}"', kind="text" if name == "category" else "number")
        if of in TAGS:
            known = [c for c in self.columns if "." not in c]
            if name not in known:
                raise ConfigError(f"condition: a tag has no field '{name}'{nearest(name, known)}")
            kind = "text" if name in TEXTS else "number"
            if of in self.main:
                return _Sql(f'(CASE WHEN e.tag = ? THEN e."{name}" END)', [of], kind)
            return _Sql(f'{self._alias(of)}."{name}"', kind=kind)
        known = [*ROLES, *TAGS]
        raise ConfigError(f"condition: '{of}' is neither ego, agent, other nor a tag{nearest(of, known)}")

    def _alias(self, tag: str) -> str:
        return self.joined.setdefault(tag, f"j{len(self.joined)}")

    def _wrong(self, node: ast.AST, text: str) -> ConfigError:
        return ConfigError(f"condition: '{ast.get_source_segment(self.text, node) or self.text}' {text}")

    def select(self, what: str, parts: Sequence[ast.expr], order: str = "") -> tuple[str, list[Any]]:
        """Return a query for rows that fulfil some of the parts, and its values."""
        where = self.where(parts)
        joins = [JOIN.format(j=alias) for alias in self.joined.values()]
        query = f"SELECT {what} FROM tags AS e {' '.join(joins)} WHERE {where.text} {order}"
        return query, [*self.joined, *where.values]


def _conjuncts(node: ast.expr) -> list[ast.expr]:
    if isinstance(node, ast.BoolOp) and isinstance(node.op, ast.And):
        return [part for value in node.values for part in _conjuncts(value)]
    return [node]


def _main_tags(node: ast.expr) -> list[str]:
    """List the tags that rows are of: of "A and B" those of A, during which there is B; of "A or B" both."""
    if isinstance(node, ast.Name) and node.id in TAGS:
        return [node.id]
    if isinstance(node, ast.BoolOp):
        found = [_main_tags(value) for value in node.values]
        return [*itertools.chain(*found)] if isinstance(node.op, ast.Or) else next((f for f in found if f), [])
    return []


def ask(index: Index, text: str, *, min_probability: float = 0.3) -> Found:
    """Find the tags of an index that fulfil a condition.

    Raises `ConfigError` for a condition that is not understood or has unknown names, `MissingExtra` without DuckDB.

    `text`: such as "cut_in and ttc_s < 2 and ego.speed_mps > 10": a tag is true for its rows; a second one where such a tag shares a
    road user and a time with the first, whose fields then are "hard_braking.deceleration_mps2". What is not known fulfils no
    comparison. `min_probability`: of the tags, unless the condition says something of `probability`.
    """
    try:
        import duckdb
    except ImportError:
        raise MissingExtra("log2sim find", "find") from None
    condition = Condition(text, index.table.column_names)
    parts = list(condition.parts)
    if not re.search(r"\bprobability\b", text):
        parts.append(ast.parse(f"probability >= {float(min_probability)!r}", mode="eval").body)
    with duckdb.connect(":memory:", config={"enable_external_access": "false", "threads": "2"}) as connection:
        import pyarrow as pa

        count = index.table.num_rows
        buffers = [None, pa.py_buffer(np.arange(count, dtype=np.int64))]  # `pa.array` loads pandas
        numbered = index.table.append_column("row", pa.Array.from_buffers(pa.int64(), count, buffers))
        connection.register("tags", numbered)
        query, values = condition.select("DISTINCT e.*", parts, "ORDER BY e.probability DESC, e.file, e.t_s, e.row")
        cursor = connection.execute(query, values)
        names = [d[0] for d in cursor.description]
        rows = tuple({k: v for k, v in zip(names, row) if v is not None and k != "row"} for row in cursor.fetchall())
        closest = () if rows else tuple(_closest(connection, condition, parts))
    return Found(rows, condition.main, closest)


def _closest(connection: Any, condition: Condition, parts: list[ast.expr]) -> list[str]:
    """Say what each part of a condition that nothing fulfils leaves, and what is nearest where one alone is in the way."""

    def count(chosen: list[ast.expr]) -> int:
        query, values = condition.select("count(DISTINCT e.row)", chosen)
        return int(connection.execute(query, values).fetchone()[0])

    sentences = []
    for part in parts:
        rest = [p for p in parts if p is not part]
        left = count(rest) if rest or condition.main else 0
        if not left:
            continue
        without = f"without '{_source(condition, part)}' there are {left}"
        nearest_value = _nearest_value(connection, condition, part, rest)
        sentences.append(", ".join(filter(None, (without, nearest_value))))
    if sentences:
        return sentences
    alone = [f"'{_source(condition, part)}' {count([part])}" for part in parts]
    return [f"each alone: {', '.join(alone)}"]


def _source(condition: Condition, part: ast.expr) -> str:
    return (ast.get_source_segment(condition.text, part) if part in condition.parts else None) or ast.unparse(part)


def _nearest_value(connection: Any, condition: Condition, part: ast.expr, rest: list[ast.expr]) -> str:
    """Describe the row that misses a comparison of a number by least; empty for other parts."""
    if not isinstance(part, ast.Compare) or len(part.ops) != 1 or type(part.ops[0]) not in COMPARISONS:
        return ""
    try:
        one, two = condition._number(part.left), condition._number(part.comparators[0])
    except ConfigError:
        return ""
    # Values stand in the order of the text: of what is selected, of joins, of the condition.
    query, values = condition.select(
        f"{one.text}, e.tag, e.agent, e.file, e.t_s",
        rest,
        f"AND {one.text} IS NOT NULL ORDER BY abs({one.text} - {two.text}), e.row LIMIT 1",
    )
    row = connection.execute(query, [*one.values, *values, *one.values, *one.values, *two.values]).fetchone()
    name = ast.unparse(part.left)
    if row is None:
        return f"of none of which {name} is known"
    return f"the nearest with {name} = {row[0]:.4g}: {row[1]} of {row[2]} in {row[3]} at {row[4]:.1f} s"
