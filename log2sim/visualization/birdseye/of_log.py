"""The fused top-down picture of a whole log: every camera's ground, from several ticks, in the map frame."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Log, Scenario
from log2sim.errors import RecordError
from log2sim.geometry import NS_PER_S
from log2sim.visualization.birdseye.ground_view import GroundView
from log2sim.visualization.birdseye.mosaic import Mosaic, TopdownPicture

MOMENTS = 15
REACH_M = 35.0
RESOLUTION_M = 0.06


def mosaic_of(log: Log, scenario: Scenario) -> TopdownPicture:
    """Paint the ground around the ego's path, or around the sensors of a roadside log.

    By the cameras that the scenario was made with, or by all of the log where it names none, as truth does.
    """
    from log2sim.perception.first_pass import cloud_origin

    used = [str(c["name"]) for c in scenario.cameras if c.get("used") and c["name"] in log.cameras]
    used = used or list(log.cameras)
    stamps = scenario.t0_ns + np.round(np.linspace(0, scenario.duration_s, MOMENTS) * NS_PER_S).astype(np.int64)
    places = np.array([cloud_origin(log, int(t))[0][:2] for t in stamps])
    low, high = places.min(axis=0) - REACH_M, places.max(axis=0) + REACH_M
    extent = (float(low[0]), float(high[0]), float(low[1]), float(high[1]))
    mosaic = Mosaic(extent_m=extent, resolution_m=RESOLUTION_M)
    for t in stamps:
        ground_z = cloud_origin(log, int(t))[1]
        views = []
        for name in used:
            stream = log.streams[name]
            i = int(np.argmin(np.abs(stream.t_ns - t)))
            map_T_cam, known = log.map_T_sensor(name, stream.t_ns[i])
            if not known[0]:
                continue
            try:
                image = stream.read(i)
            except RecordError:
                continue
            views.append(GroundView.from_pose(image, log.cameras[name], map_T_cam[0], ground_z))
        mosaic.add(views)
    return mosaic.picture()
