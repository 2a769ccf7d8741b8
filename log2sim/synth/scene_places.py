"""What stands and lies in a scene: roads with their markings, crosswalks, stop lines, arrows, buildings and shadows."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from log2sim.synth.scene_keys import Color, Coordinate, Line, Name, Number, Size, Table, Vec2, Vec3, Whole, key

PaintColor = Literal["white", "yellow"]
LampState = Literal["red", "red_yellow", "yellow", "green", "off"]
Share = Annotated[Number, Field(ge=0, le=1)]
Length = Annotated[Number, Field(ge=0.1, le=100)]

WORN = "Share of the paint that is worn off, in patches."


class Road(Table):
    """A road along a polyline, with markings and sidewalks."""

    line: Line = key("Center line, points [x, y].", unit="m")
    width_m: Number = key("Width of the carriageway.", 7.0, "m", ge=1, le=60)
    lanes: Whole = key("Number of lanes of equal width.", 2, ge=1, le=12)
    lanes_back: Whole | None = key(
        "Number of lanes that lead against the line, 0 for a one-way road; by default half of them.", None, ge=0, le=12
    )
    marking: Literal["dashed", "solid", "none"] = key("Marking between lanes.", "dashed")
    center_marking: Literal["dashed", "solid", "double", "none"] | None = key(
        "Marking between the two directions; by default as between lanes.", None
    )
    side_marking: Literal["dashed", "solid", "none"] = key("Markings along both sides.", "solid")
    side_line_m: Number = key("Width of the markings along both sides.", 0.1, "m", ge=0.05, le=0.5)
    side_inset_m: Number = key("From the middle of these markings to the end of the road.", 0.2, "m", ge=0.1, le=10)
    color: PaintColor = key("Color of the markings.", "white")
    center_color: PaintColor | None = key("Color of the marking between the two directions.", None)
    dash_m: tuple[Length, Length] | None = key(
        "Length of a dash and of the gap behind it; by default 3 and 3, begun anew at each point of the line.",
        None,
        "m",
    )
    worn: Share = key(WORN, 0.0, "1")
    missing_m: tuple[Vec2, ...] = key("Stretches [begin, end] along the line without any marking.", (), "m")
    old_m: tuple[Coordinate, ...] = key(
        "How far to the left of the markings between lanes removed ones still shine through.", (), "m"
    )
    sidewalk_m: Number = key("Width of the sidewalk on each side.", 2.5, "m", ge=0, le=20)

    @property
    def backward_lanes(self) -> int:
        """Number of lanes that lead against the line."""
        return self.lanes // 2 if self.lanes_back is None else self.lanes_back

    @model_validator(mode="after")
    def _some_lanes_back(self) -> Self:
        if self.backward_lanes > self.lanes:
            raise ValueError(f"road: lanes_back is {self.lanes_back}, but the road has {self.lanes} lanes")
        return self


class Zebra(Table):
    """A crosswalk."""

    line: Line = key("Its center line from one side of the road to the other, points [x, y].", unit="m")
    width_m: Number = key("Extent along the road.", 3.0, "m", ge=1, le=20)
    worn: Share = key(WORN, 0.0, "1")


class StopLine(Table):
    """A line across a lane at which vehicles wait."""

    line: Line = key("From one side of the lane to the other, points [x, y].", unit="m")
    width_m: Number = key("Extent along the lane.", 0.5, "m", ge=0.1, le=2)
    color: PaintColor = key("Color of the paint.", "white")
    worn: Share = key(WORN, 0.0, "1")


class Arrow(Table):
    """An arrow in a lane."""

    position: Vec2 = key("Its middle [x, y].", unit="m")
    yaw_deg: Number = key("Direction that it points in, of one that bends the direction of its shaft.", 0.0, "deg")
    shape: Literal["straight", "left", "right"] = key("Where it points.", "straight")
    length_m: Number = key("Its length.", 5.0, "m", ge=1, le=12)
    worn: Share = key(WORN, 0.0, "1")


class Building(Table):
    """A box with a facade."""

    center: Vec2 = key("Center [x, y].", unit="m")
    size_m: Size = key("Length, width, height.", unit="m")
    yaw_deg: Number = key("Direction of its length.", 0.0, "deg")
    color: Color = key("Color of the facade, RGB 0 to 255.", (190, 180, 165))
    shadow: Annotated[bool, Field(strict=True)] = key("Whether it throws a shadow on the ground.", False)


class TrafficLight(Table):
    """A signal head of a traffic light with a red, a yellow and a green lamp."""

    id: Name = key("Unique name of letters, digits, '_' and '-'.")
    position: Vec3 = key("Middle of its housing [x, y, z].", unit="m")
    yaw_deg: Number = key("Direction that its lamps face.", 0.0, "deg")
    program: Annotated[tuple[tuple[LampState, Length], ...], Field(min_length=1)] = key(
        "Rows [state, seconds], again and again.", unit="1, s"
    )
    start_s: Annotated[Number, Field(ge=-1000, le=0)] = key("Time at which the program begins.", 0.0, "s")
    pole: Annotated[bool, Field(strict=True)] = key("Whether a pole behind it carries it.", True)


class Shadow(Table):
    """A shadow on the ground with sharp edges, of a tree or a house that is not in the scene."""

    outline: Annotated[tuple[Vec2, ...], Field(min_length=3)] = key("Its convex outline, points [x, y].", unit="m")
