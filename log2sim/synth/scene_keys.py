"""Kinds of numbers and tables that scene files are made of."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, JsonValue, Strict

MAX_COORDINATE_M = 1e7

Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Coordinate = Annotated[float, Strict(), Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Extent = Annotated[float, Strict(), Field(ge=0.1, le=500)]
Angle = Annotated[float, Strict(), Field(ge=-90, le=90)]
Channel = Annotated[int, Strict(), Field(ge=0, le=255)]
Pixels = Annotated[int, Strict(), Field(ge=16, le=8192)]
Name = Annotated[str, Field(pattern=r"^[\w-]+$")]

Vec2 = tuple[Coordinate, Coordinate]
Vec3 = tuple[Coordinate, Coordinate, Coordinate]
Size = tuple[Extent, Extent, Extent]
Color = tuple[Channel, Channel, Channel]
Line = Annotated[tuple[Vec2, ...], Field(min_length=2)]


def key(description: str, default: Any = ..., unit: str | None = None, **limits: Any) -> Any:
    """Declare a key of a scene file: what it means, its default, its unit and its limits (`ge`, `le`, `max_length` ...)."""
    extra: dict[str, JsonValue] = {} if unit is None else {"unit": unit}
    return Field(default, description=description, json_schema_extra=extra, **limits)


class Table(BaseModel):
    """Base of all tables of a scene file: immutable, unknown keys are errors."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
