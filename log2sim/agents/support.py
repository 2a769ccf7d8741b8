"""What the points of the LiDAR say about an agent."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Support:
    """Rays toward the solid part of an agent over its life, and the surfaces that its points are on.

    Attributes
    ----------
    inside, through, before : int
        Rays that end at the agent, that go on behind it, and that end before it; the first two at `seen_ticks`.
    seen_ticks : int
        Ticks at which most rays toward it do not end before it.
    in_structure : float
        Share of the searched ticks at which nearly all of its points are part of something longer than any of its kind.
    beside_structure : float
        Likewise, of most of its points.
    unreached : bool
        Whether it is pointless, most rays toward it do not end in it, and the cameras that detect it are where the LiDARs are.
    pointless : bool
        Whether the LiDAR looks toward it and none of its detections has a point.
    shown_ticks : int
        Ticks at which it is not hidden and a searched camera shows it well.
    detected_ticks : int
        Those of them at which it was detected, in an image or a sweep.
    image_ticks : int
        Those of them at which it was detected in an image.
    image_height_share : float, optional
        Height that its image boxes span at its distance over the height of its points, the median; None with few of both.
    """

    inside: int = 0
    through: int = 0
    before: int = 0
    seen_ticks: int = 0
    in_structure: float = 0.0
    beside_structure: float = 0.0
    unreached: bool = False
    pointless: bool = False
    shown_ticks: int = 0
    detected_ticks: int = 0
    image_ticks: int = 0
    image_height_share: float | None = None

    @property
    def through_share(self) -> float | None:
        """Share of the rays that met its place and went through; None without any."""
        met = self.inside + self.through
        return self.through / met if met else None
